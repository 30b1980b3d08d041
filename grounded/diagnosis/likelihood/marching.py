"""Compiled rollouts of a hypothesis: thousands of steps without Python between them.

Predicting a whole log takes its steps one after the other, and each costs a millisecond of Python
if effects add to the model's step. `grounded.effects.wrap` implements the same equations, so the
effects that change the step are wrapped around the model for this purpose, with their values as
parameters: it is compiled once for all values. The first step is checked against
`Predictor.advance`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from grounded.compile import Named, system_of
from grounded.compile.run.interpreted import System
from grounded.diagnosis.likelihood.arriving import delayed
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.joint_memory import remembering
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.effects import Effect, LossFamily, MediumFamily, RateFamily, wrap
from grounded.effects.losses import memory_name
from grounded.effects.plain_step import param_name, plain_step
from grounded.effects.sensed import behind_logs
from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded.model import Model, Param

if TYPE_CHECKING:
    from grounded.diagnosis.likelihood.predictor import Predictor


def arriving_name(name: str) -> str:
    """Return the parameter that says by what part of a step an input is late."""
    return f"{name}_arriving"


Times = Array | float  # [s] within the trial, of each row (M,) or of all
STEPS_TO_COMPILE = 50  # fewest steps for which compiling pays
AGREE = 1e-9  # tolerance of the check, relative to a state's size
CARRIED = 1e-3  # the same for a heading rate, which `advance` computes by a short finite step


@dataclass(frozen=True, eq=False)
class March:
    """The compiled step of a model with effects, and the names of its parameters."""

    system: System
    names: tuple[str, ...]  # parameters: those of the hypothesis' effects before adopted ones

    def __call__(
        self, predictor: Predictor, h: Hypothesis, x: Array, u: Array, t: Times, parts: Array
    ) -> Array:
        """Roll out from x (M, n) at times t with u (T, M, m or 2 m): states (T + 1, M, n).

        Memories of joints may stand behind the states. parts (m,): see `Arrival.of`.
        """
        own = dict(zip(predictor.data.model.param_names, predictor.params(h), strict=True))
        own |= zip(map(arriving_name, predictor.data.model.input_names), parts, strict=False)
        for effect, values in h.pairs:
            whole = effect.complete(values)
            own |= {param_name(effect.name, name): value for name, value in whole.items()}
        march = getattr(self.system, "march")  # noqa: B009
        p = np.array([own[name] for name in self.names])
        n, clocks = x.shape[-1], self.system.n - x.shape[-1]
        clock = np.broadcast_to(np.reshape(t, (-1, 1)), (len(x), clocks))
        return np.asarray(march(np.hstack([x, clock]), u, p, predictor.data.dt)[..., :n])


def marched(
    predictor: Predictor, h: Hypothesis, x: Array, u: Array, t: Times = 0.0
) -> Array | None:
    """Roll out from x (M, n) at times t with received u (T, M, m or 2 m): states (T + 1, M, n).

    None if the hypothesis can't be compiled, or there are too few steps for that to pay.
    """
    m, data = predictor.data.model.m, predictor.data
    if predictor.params(h).ndim > 1:
        return None
    led = u[..., m:].any(axis=(1, 2))
    u = u if led.any() else np.ascontiguousarray(u[..., :m])
    parts = delayed(h.acting, data) if led.any() and predictor.divisible else None
    arrival = Arrival.of(parts, predictor.divisible) if led.any() else None
    acting = (e.name for e, _ in h.pairs if isinstance(e.family, LossFamily | RateFamily))
    key, given = (*acting, arrival), np.zeros(0) if parts is None else parts
    if key not in predictor.marches:
        if len(u) < STEPS_TO_COMPILE:
            return None
        march = _compiled(predictor, h, arrival)
        if march is not None:
            k = int(led.argmax())  # a step within which inputs change, if any do
            first = predictor.advance(h, x, u[k], np.broadcast_to(t, len(x)))
            off = np.abs(march(predictor, h, x, u[k : k + 1], t, given)[1] - first)
            room = np.full(first.shape[-1], AGREE)
            room[[rate for _, rate in predictor.tied]] = CARRIED
            march = march if (off <= room * (1 + np.abs(first))).all() else None
        predictor.marches[key] = march
    found = predictor.marches[key]
    return None if found is None else found(predictor, h, x, u, t, given)


class Arrival(NamedTuple):
    """How inputs change within a step: `Predictor._within`, in the order in which they arrive."""

    order: tuple[tuple[int, ...], ...] | None  # inputs that arrive together, earliest first
    divisible: bool

    @classmethod
    def of(cls, parts: Array | None, divisible: bool) -> Arrival:
        """Return the order of arrival after `parts` (m,) of a step; None: leads are all we know."""
        if parts is None:
            return cls(None, divisible)
        late = sorted({part for part in parts.tolist() if part > 0})
        return cls(tuple(tuple(np.flatnonzero(parts == part).tolist()) for part in late), divisible)

    def around(self, model: Model) -> Model:
        """Return the model with leads among its inputs, and `parts` among its parameters."""
        base, names = plain_step(model), model.input_names
        leads = {f"{name}_lead": model.inputs[name] for name in names}
        late = {arriving_name(names[j]): Param(0.5, "1") for own in self.order or () for j in own}

        def held(a: Any) -> Named:
            return Named("input", names, [a[n] for n in names])

        def in_parts(s: Any, a: Any, p: Any, dt: Any) -> dict[str, Any]:
            assert self.order is not None
            at: Any = 0.0
            part = {j: p[arriving_name(names[j])] for own in self.order for j in own}
            sent, before = {n: a[n] for n in names}, dict[int, Any]()
            for j, late in part.items():  # an input's mean over the step, and when it changes
                change = 2 * a[f"{names[j]}_lead"] / (late * (1 - late))
                sent[names[j]], before[j] = a[names[j]] - late * change, change
            for k, own in enumerate((*self.order, ())):
                end = part[own[0]] if own else 1.0
                still = {names[j]: before[j] for group in self.order[k:] for j in group}
                now = [sent[n] + still.get(n, 0.0) for n in names]
                after = base(s, Named("input", names, now), p, (end - at) * dt)
                s, at = (
                    Named("state", model.state_names, [after[n] for n in model.state_names]),
                    end,
                )
            return dict(s)

        def led(s: Any, a: Any, p: Any, dt: Any) -> dict[str, Any]:
            def less(x: Any, than: Any) -> dict[str, Any]:
                return {n: x[n] - than[n] for n in than}

            def moved(by: Any) -> Any:
                start = [s[n] + by[n] for n in model.state_names]
                return base(Named("state", model.state_names, start), held(a), p, dt)

            early = Named("input", names, [a[n] + a[f"{n}_lead"] for n in names])
            after, more = base(s, held(a), p, dt), base(s, early, p, dt)
            first = less(more, after)
            by = less(less(moved(first), after), first)
            last = less(moved(by), after) if self.divisible else by
            return {n: after[n] + by[n] + 0.5 * (by[n] - last[n]) for n in after}

        step = in_parts if self.order is not None else led
        vars(step)["bare"] = model
        written = model.step or model.derivative
        vars(step)["__wrapped__"] = getattr(written, "__wrapped__", written)
        inputs, params = {**model.inputs, **leads}, {**model.params, **late}
        roles, angles = model.roles, model.angles
        return Model(model.states, inputs, params, angles=angles, roles=roles, step=step)


def _compiled(predictor: Predictor, h: Hypothesis, arrival: Arrival | None) -> March | None:
    data, families = predictor.data, [effect.family for effect in h.effects]
    if simulated(data.model) or behind_logs(data.model) is not None:
        return None
    if any(isinstance(f, MediumFamily) for f in families):
        return None
    if arrival is not None and any(getattr(f, "parts", 0) for f in families):
        return None  # limits of rates step without leads
    try:
        model = data.model if arrival is None else arrival.around(data.model)
        for effect, values in sorted(h.pairs, key=lambda pair: _outer(pair[0])):
            if isinstance(effect.family, LossFamily | RateFamily):
                at = replace(effect.site, model=model)
                model = wrap(replace(effect, site=at), values, data.dt)
        known = {
            *data.model.state_names,
            *(memory_name(e, z) for e, _, own in remembering(h) for z in own),
        }
        clocks = [name for name in model.state_names if name not in known]
        if model.step is None or not all(name.endswith("_clock") for name in clocks):
            return None
        names = (model.state_names, model.input_names, model.param_names)
        states, inputs, params = names
        system = system_of(
            model.step,
            kind="step",
            states=states,
            inputs=inputs,
            params=params,
            derivatives=False,
        )
    except GroundedError:
        return None
    return March(system, params) if hasattr(system, "march") else None


def _outer(effect: Effect) -> bool:
    """Sort key: losses, solved within a step, are wrapped before rates, added around it."""
    return isinstance(effect.family, RateFamily)
