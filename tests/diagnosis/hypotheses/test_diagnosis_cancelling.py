"""Effects that cancel explain nothing, however likely they make the data."""

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.causes import meaning
from grounded.diagnosis.hypotheses.explored import FittedHypotheses
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.parts import Estimate
from grounded.effects import Library


def turning():
    """A heading rate that follows its command."""
    return Model(
        name="turner",
        states={"psi": "rad", "w": "rad/s"},
        inputs={"c": "rad/s"},
        params={"tau": Param(0.12, "s")},
        angles=("psi",),
        derivative=lambda s, a, p: {"psi": s.w, "w": (0.88 * a.c - s.w) / p.tau},
    )


@pytest.fixture(scope="module")
def turned():
    model, rng, dt = turning(), np.random.default_rng(1), 0.05
    c = np.repeat(rng.uniform(-1.2, 1.2, 30), 10)
    states = [np.zeros(2)]
    for value in c:
        step = model.system.step(states[-1][None], np.array([[value]]), model.values, dt)
        states.append(step[0])
    y = np.array(states) + 1e-3 * rng.standard_normal((len(states), 2))
    data = prepare(model, [Trial(y, c[:, None], dt, model.state_names, model.input_names)])
    return FittedHypotheses(data, Library().candidates(model, data.scales))


LESS = {
    "rate_gain:w": {"g": 0.498},
    "input_gain:c": {"g": -0.317},
    "viscous_friction:w": {"k": -3.9},
}


def of(known, values):
    h, by_name = Hypothesis(), {effect.name: effect for effect in known.candidates}
    for name, some in values.items():
        h = h.plus(by_name[name], some)
    return h


@pytest.mark.parametrize(
    ("change", "refused"),
    [
        ({}, True),
        ({"viscous_friction:w": {"k": 1.0}}, False),  # it adds to what the weaker input does
        ({"rate_gain:w": {"g": 0.04}, "viscous_friction:w": {"k": -0.3}}, False),  # all weaker
    ],
)
def test_three_effects_that_cancel_are_refused(turned, change, refused):
    """Half as fast again, of a weaker input, with less friction: a 3 % shorter time constant."""
    h = of(turned, LESS | change)
    assert turned.cancelling(h) == refused
    for name in LESS:  # two of them do something
        assert not turned.cancelling(h.minus(name))


@pytest.mark.parametrize("family", ["viscous_friction", "coulomb_friction", "quadratic_drag"])
def test_less_friction_than_modelled_is_said_so(turned, family):
    effect = {effect.name: effect for effect in turned.candidates}[f"{family}:w"]
    name = effect.free[0].name
    more, less = (meaning(effect, {name: Estimate(v, unit="1/s")}) for v in (3.9, -3.9))
    assert "3.9 1/s" in more and "less" not in more
    assert "3.9 1/s" in less and "less" in less and "-" not in less
