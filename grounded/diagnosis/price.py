"""What naming an effect costs: the price of its numbers, of looking for it, of where it might be.

    price = k/2 ln N + ln(places looked at) + ln(targets of the family)

k free values, N time steps. Thresholds, frequencies and places that were scanned pay for the
looking, and families that could have been blamed at many targets for the choice. A parameter of the
model pays by its prior (a fifth of its size) instead.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from grounded.diagnosis.hypothesis import Hypothesis, Predictor
from grounded.effects import Effect, ParamFamily

PARAM_PRIOR = 0.2  # prior relative error of one parameter that is blamed
BRIEF = 0.1  # of a control step: shorter delays and lags are a matter of time stamps
TIMES = {"delay": "d", "sensor_delay": "d", "first_order_lag": "tau"}
SAME = 0.05  # part of a dead zone's power that a mere offset may lack and still be the same


def price(
    predictor: Predictor, effect: Effect, values: Mapping[str, float], targets: int = 1
) -> float:
    """What an effect pays beside its likelihood [nats].

    Args:
        predictor: the data.
        effect: which.
        values: its values, for those whose price depends on them.
        targets: at how many targets its family could have been blamed.
    """
    data = predictor.data
    if isinstance(effect.family, ParamFamily):
        return math.log(targets) + _of_parameter(effect, values, data.steps)
    if values.get(TIMES.get(effect.family.name, ""), math.inf) < BRIEF * data.dt:
        return math.inf
    numbers = len(effect.free) + sum(q.tuned for q in effect.quantities)
    cost = 0.5 * numbers * math.log(max(data.steps, 2)) + effect.family.vague
    if not _mere_offset(predictor, effect, values):
        cost += math.log(effect.places)
    return cost + math.log(targets)


def _of_parameter(effect: Effect, values: Mapping[str, float], steps: int) -> float:
    """A normal prior of a fifth of the parameter's size, not a free parameter's cost."""
    value = effect.site.model.params[effect.site.target].value
    size = PARAM_PRIOR * (abs(value) or 1.0)
    return 0.5 * (values.get("d", 0.0) / size) ** 2 + 0.25 * math.log(max(steps, 2)) + 1.0


def _mere_offset(predictor: Predictor, effect: Effect, values: Mapping[str, float]) -> bool:
    """Whether a dead zone acts as one offset all the time, because nothing ever rests in it.

    Then its threshold was not searched for among many: any would have been the same effect.
    """
    if effect.family.name != "dead_zone" or "c" not in values:
        return False
    data, x = predictor.data, predictor.data.y[:-1]
    model, j = data.model, data.model.input_names.index(effect.site.target)
    zone = predictor.inputs(Hypothesis().plus(effect, values))
    plain = predictor.inputs(Hypothesis())
    offset = plain.copy()
    offset[..., j] -= values["c"] * np.sign(plain[..., j].mean())
    p = predictor.params(Hypothesis())
    acts, missed = 0.0, 0.0
    after = predictor.step(x, zone, p)
    for other in (plain, offset):
        moved = model.difference(predictor.step(x, other, p), after)
        size = float((moved**2 * data.valid.T[..., None]).sum())
        acts, missed = (size, missed) if other is plain else (acts, size)
    return missed <= SAME * acts
