"""A hypothesis as one compiled step: thousands of steps in a row without Python between them.

A prediction of a whole log asks for one step after the other; each costs a millisecond of Python
where effects add to the model's own. What `grounded.effects.wrap` adopts are the same equations,
so what moves the model joins it for this alone, with its numbers as parameters: one compile serves
every value. The first step is compared with `Predictor.advance`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from grounded.compile import System, system_of
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.effects import Effect, LossFamily, MediumFamily, RateFamily, wrap
from grounded.effects.plain_step import param_name
from grounded.effects.sensed import behind_logs
from grounded.errors import GroundedError
from grounded.frozen import Array

if TYPE_CHECKING:
    from grounded.diagnosis.likelihood.predictor import Predictor

LONG = 400  # steps from which a compile pays
AGREE = 1e-9  # of a state's size: steps that are one
CARRIED = 1e-3  # the same of a heading's rate, whose own change `advance` takes over a short step


@dataclass(frozen=True, eq=False)
class March:
    """The compiled step of a model with effects, and where their numbers go."""

    system: System
    names: tuple[str, ...]  # of its parameters: what joins goes before what was adopted

    def __call__(self, predictor: Predictor, h: Hypothesis, x: Array, u: Array) -> Array:
        """States (T + 1, M, n) from x (M, n) through u (T, M, m)."""
        own = dict(zip(predictor.data.model.param_names, predictor.params(h), strict=True))
        for effect, values in h.pairs:
            whole = effect.complete(values)
            own |= {param_name(effect.name, name): value for name, value in whole.items()}
        march = getattr(self.system, "march")  # noqa: B009
        p = np.array([own[name] for name in self.names])
        return np.asarray(march(x, u, p, predictor.data.dt))


def marched(predictor: Predictor, h: Hypothesis, x: Array, u: Array) -> Array | None:
    """States (T + 1, M, n) from x (M, n) through received inputs u (T, M, m), far ones and all.

    None where a hypothesis can't be compiled, or so few steps are asked for that it doesn't pay.
    """
    if predictor.params(h).ndim > 1:
        return None
    if h.names not in predictor.marches:
        if len(u) < LONG:
            return None
        march = _compiled(predictor, h)
        if march is not None:
            first = predictor.advance(h, x, u[0], np.zeros(len(x)))
            off = np.abs(march(predictor, h, x, u[:1])[1] - first)
            room = np.full(first.shape[-1], AGREE)
            room[[rate for _, rate in predictor.tied()]] = CARRIED
            march = march if (off <= room * (1 + np.abs(first))).all() else None
        predictor.marches[h.names] = march
    found = predictor.marches[h.names]
    return None if found is None else found(predictor, h, x, u)


def _compiled(predictor: Predictor, h: Hypothesis) -> March | None:
    data, families = predictor.data, [effect.family for effect in h.effects]
    if simulated(data.model) or behind_logs(data.model) is not None:
        return None
    if any(isinstance(f, MediumFamily) or getattr(f, "timed", False) for f in families):
        return None
    model = data.model
    try:
        for effect, values in sorted(h.pairs, key=lambda pair: _outer(pair[0])):
            if isinstance(effect.family, LossFamily | RateFamily):
                at = replace(effect.site, model=model)
                model = wrap(replace(effect, site=at), values, data.dt)
        if model.step is None or model.n != data.model.n:
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
    """Losses are solved within a step, rates are added around it."""
    return isinstance(effect.family, RateFamily)
