"""Added rates are of second order in the control step: their values don't depend on it."""

import numpy as np
import pytest

from grounded import Model, Trial
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects import Library, wrap

boat = Model(
    states={"x": "m", "y": "m", "psi": "rad", "u": "m/s", "v": "m/s", "r": "rad/s"},
    inputs={"push": "m/s^2", "turn": "rad/s^2"},
    params={},
    derivative=lambda s, a, p: {
        "x": s.u * np.cos(s.psi) - s.v * np.sin(s.psi),
        "y": s.u * np.sin(s.psi) + s.v * np.cos(s.psi),
        "psi": s.r,
        "u": a.push,
        "v": -s.v,
        "r": a.turn - s.r,
    },
    angles=("psi",),
    roles={"position": ("x", "y"), "heading": "psi", "speed": "u", "heading_rate": "r"},
    name="boat",
)
EFFECTS = {
    "quadratic_drag:u": {"k": 0.9},
    "viscous_friction:u": {"k": 1.5},
    "coriolis:v": {"k": -0.7},
    "coupling:v<-r": {"k": 0.8},
}
START = np.array([0.0, 0.0, 0.0, 1.0, 0.2, 0.5])


def driven(dt, seconds=1.0):
    """Steps of both inputs that are on the grid of every dt here."""
    t = np.arange(round(seconds / dt)) * dt
    return np.column_stack(
        [np.where(t < 0.4 - 1e-9, 0.8, -0.3), np.where(t < 0.6 - 1e-9, 1.0, -1.0)]
    )


def roll(model, u, dt):
    states = [START]
    for a in u:
        states.append(model.system.step(states[-1][None], a[None], model.values, dt)[0])
    return np.array(states)


def effect(name, dt):
    u = driven(dt)
    states = roll(boat, u, dt)
    data = prepare(boat, [Trial(states, u, dt, boat.state_names, boat.input_names)])
    return Library().effect(name, data.model, data.scales), data


def end(name, dt):
    model = wrap(effect(name, dt)[0], EFFECTS[name], dt)
    return roll(model, driven(dt), dt)[-1]


@pytest.mark.parametrize("name", EFFECTS)
def test_half_the_step_leaves_a_quarter_of_the_error(name):
    true = end(name, 0.0005)
    coarse, fine = (np.abs(end(name, dt) - true).max() for dt in (0.1, 0.05))
    assert fine < coarse / 3 and coarse < 2e-3


@pytest.mark.parametrize("name", EFFECTS)
def test_the_diagnosis_and_the_adopted_model_make_the_same_step(name):
    one, data = effect(name, 0.1)
    h, predictor = Hypothesis().plus(one, EFFECTS[name]), Predictor(data)
    x, u = data.y[:-1], predictor.inputs(h)
    diagnosed = predictor.advance(h, x, u, data.time)
    model = wrap(one, EFFECTS[name], data.dt)
    adopted = model.system.step(*predictor.flat(x, u), model.values, data.dt)
    np.testing.assert_allclose(adopted.reshape(x.shape), diagnosed, atol=1e-12)
