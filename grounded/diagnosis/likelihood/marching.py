"""Compiled rollouts of a hypothesis: thousands of steps without Python between them.

Predicting a whole log takes its steps one after the other, and each costs a millisecond of Python
if effects add to the model's step. `grounded.effects.wrap` implements the same equations, so the
effects that change the step are wrapped around the model for this purpose, with their values as
parameters: it is compiled once for all values. The first step is checked against
`Predictor.advance`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from grounded.compile import System, system_of
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.joint_memory import remembering
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.effects import Effect, LossFamily, MediumFamily, RateFamily, wrap
from grounded.effects.losses import memory_name
from grounded.effects.plain_step import param_name
from grounded.effects.sensed import behind_logs
from grounded.errors import GroundedError
from grounded.frozen import Array

if TYPE_CHECKING:
    from grounded.diagnosis.likelihood.predictor import Predictor

Times = Array | float  # [s] within the trial, of each row (M,) or of all
LONG = 100  # fewest steps for which compiling pays
AGREE = 1e-9  # tolerance of the check, relative to a state's size
CARRIED = 1e-3  # the same for a heading rate, which `advance` computes by a short finite step


@dataclass(frozen=True, eq=False)
class March:
    """The compiled step of a model with effects, and the names of its parameters."""

    system: System
    names: tuple[str, ...]  # parameters: those of the hypothesis' effects before adopted ones

    def __call__(self, predictor: Predictor, h: Hypothesis, x: Array, u: Array, t: Times) -> Array:
        """Roll out from x (M, n) at times t with u (T, M, m): states (T + 1, M, n).

        Memories of joints may stand behind the states (`joint_memory`).
        """
        own = dict(zip(predictor.data.model.param_names, predictor.params(h), strict=True))
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
    """Roll out from x (M, n) at times t with received u (T, M, m): states (T + 1, M, n).

    None if the hypothesis can't be compiled, or there are too few steps for that to pay.
    """
    if predictor.params(h).ndim > 1:
        return None
    if h.names not in predictor.marches:
        if len(u) < LONG:
            return None
        march = _compiled(predictor, h)
        if march is not None:
            first = predictor.advance(h, x, u[0], np.broadcast_to(t, len(x)))
            off = np.abs(march(predictor, h, x, u[:1], t)[1] - first)
            room = np.full(first.shape[-1], AGREE)
            room[[rate for _, rate in predictor.tied]] = CARRIED
            march = march if (off <= room * (1 + np.abs(first))).all() else None
        predictor.marches[h.names] = march
    found = predictor.marches[h.names]
    return None if found is None else found(predictor, h, x, u, t)


def _compiled(predictor: Predictor, h: Hypothesis) -> March | None:
    data, families = predictor.data, [effect.family for effect in h.effects]
    if simulated(data.model) or behind_logs(data.model) is not None:
        return None
    if any(isinstance(f, MediumFamily) for f in families):
        return None
    model = data.model
    try:
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
