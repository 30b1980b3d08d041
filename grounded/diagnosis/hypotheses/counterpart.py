"""Effects that a parameter's shift undoes, such as a force 20 % larger beside a mass 20 % larger.

Neither is a finding: the little that remains of the two (a curvature of the model, the first
samples of a trial) can be expressed by the parameter alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from grounded.diagnosis.hypotheses.explored import LEFT, sizes
from grounded.diagnosis.likelihood.fitted import calibrated
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects import InputFamily, LossFamily, MediumFamily, ParamFamily, RateFamily
from grounded.frozen import Array


def counterparts(predictor: Predictor, h: Hypothesis) -> list[str]:
    """Return the names of effects on inputs and rates that some parameter's shift nearly cancels.

    Both act beside the rest of the hypothesis. They cancel if together they change a step by less
    than LEFT of what each changes alone.
    """
    kinds = RateFamily | InputFamily | LossFamily | MediumFamily
    effects = [e.name for e in h.effects if isinstance(e.family, kinds)]
    bare = list(_unshifted(predictor, h)) if effects else []
    if not bare:
        return []
    x, data, size = predictor.data.y[:-1], predictor.data, sizes(predictor)

    def step(of: Hypothesis) -> Array:
        return predictor.next(of, x)

    def between(after: Array, before: Array) -> float:
        moved = data.model.difference(after, before) / size
        return float(np.sqrt(np.sum(moved**2 * data.valid.T[..., None])))

    whole, found = step(h), []
    less = {name: step(h.minus(name)) for name in effects}
    for other in bare:
        rest = step(other)  # all effects, the parameter at its nominal value
        for name in effects:
            shift, effect = between(whole, rest), between(whole, less[name])
            if name not in found and abs(shift - effect) < LEFT * min(shift, effect):
                both = between(whole, step(other.minus(name)))
                if both < LEFT * min(shift, effect):
                    found.append(name)
    return found


def _unshifted(predictor: Predictor, h: Hypothesis) -> Iterator[Hypothesis]:
    """Yield the hypothesis with each parameter that it shifts back at its nominal value."""
    for effect in h.effects:
        if isinstance(effect.family, ParamFamily):
            yield h.minus(effect.name)
    if h.spread > 0 and h.shift is not None:
        for i in calibrated(predictor.data):
            shift = h.shift.copy()
            shift[i] = 0.0
            yield replace(h, shift=shift)
