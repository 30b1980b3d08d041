"""Two rates that cancel explain nothing, however likely they make the data."""

import numpy as np
import pytest

from grounded import Trial
from grounded.diagnosis.hypotheses.explored import FittedHypotheses
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.effects import Library
from grounded.models.car import model as car


@pytest.fixture(scope="module")
def straight():
    """A car that drives straight ahead: ahead of it and along x are the same."""
    rng, n = np.random.default_rng(0), 80
    v = np.linspace(1, 3, n + 1)
    states = np.zeros((n + 1, car.n))
    states[:, car.state_names.index("v")] = v
    states[:, car.state_names.index("x")] = 0.05 * np.cumsum(v)
    states += 1e-3 * rng.standard_normal(states.shape)
    inputs = np.column_stack([np.zeros(n), np.linspace(0.2, 0.8, n)])
    data = prepare(car, [Trial(states, inputs, 0.05, car.state_names, car.input_names)])
    return FittedHypotheses(data, Library().candidates(car, data.scales))


@pytest.mark.parametrize(("ahead", "refused"), [(8.41, True), (-8.41, False), (2.0, False)])
def test_drifts_that_cancel_are_refused(straight, ahead, refused):
    world, body = (Library().effect(f"drift_{n}:x+y", car) for n in ("world", "body"))
    h = Hypothesis().plus(world, {"a": -8.55, "b": 0.0}).plus(body, {"a": ahead, "b": 0.0})
    assert straight.cancelling(h) == refused
