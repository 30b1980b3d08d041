"""States that were measured seldom or never: no effect is made of what nobody looked at."""

from dataclasses import replace

import numpy as np
import pytest

from grounded import Trial
from grounded.diagnosis.diagnose import diagnose
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.models.pendulum import model as pendulum

DT = 0.02
DISTURBED = np.sqrt(DT) * np.array([0.004, 0.06])  # of a step
MEASURED = np.array([0.005, 0.05])


def swings(trials=3, steps=150, seed=0, friction=0.0):
    """Runs of the pendulum itself (or with more friction), disturbed, from moving starts."""
    values = pendulum.values.copy()
    values[pendulum.param_names.index("b")] += friction
    rng, found = np.random.default_rng(seed), []
    for _ in range(trials):
        t, x = np.arange(steps) * DT, rng.uniform(-1, 1, 2)
        u = 1.5 * np.sin(rng.uniform(3, 5) * t) + np.sin(rng.uniform(7, 9) * t + 1)
        states = [x]
        for value in u:
            x = pendulum.system.step(x[None], np.array([[value]]), values, DT)[0]
            x = x + DISTURBED * rng.standard_normal(2)
            states.append(x)
        y = np.array(states) + MEASURED * rng.standard_normal((steps + 1, 2))
        found.append(Trial(y, u[:, None], DT, ("theta", "omega"), ("torque",)))
    return found


def seen_every(trials, state, every):
    """The same with one state measured now and then; every = 0: never."""
    for trial in trials:
        keep = np.zeros(trial.steps + 1, bool)
        if every:
            keep[::every] = True
        states = trial.states.copy()
        states[~keep, state] = np.nan
        yield replace(trial, states=states)


@pytest.mark.parametrize(("state", "every"), [(0, 10)])
def test_a_state_that_is_measured_now_and_then_leaves_its_noise_to_be_found(state, every):
    trials = list(seen_every(swings(6, 200, 3), state, every))
    data = prepare(pendulum, trials)
    noise = HypothesisSearch(data, ()).nulls().noise
    assert np.exp(noise.log_q[1] / 2) == pytest.approx(DISTURBED[1], rel=0.3)
    assert np.exp(noise.floor[state] / 2) < 0.1 * DISTURBED[state]
    found = diagnose(pendulum, trials)
    assert found.kind == "none" and 0.85 < found.gap.after < 1.15
