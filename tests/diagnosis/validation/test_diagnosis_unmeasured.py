"""States that were measured seldom or never: no effect is made of what nobody looked at."""

from dataclasses import replace

import numpy as np
import pytest

from grounded import Trial
from grounded.diagnosis.diagnose import diagnose
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.linearise import prior, smoothed
from grounded.filter import kalman
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


@pytest.mark.parametrize("seed", [1])
def test_a_speed_that_is_never_measured_is_no_effect(seed):
    """Runs of 450 steps are cut in three: each part starts with a speed that nobody knows."""
    found = diagnose(pendulum, list(seen_every(swings(3, 450, seed), 1, 0)))
    assert found.kind == "none" and not found.leftover
    assert 0.85 < found.gap.after < 1.15
    assert found.noise.process["omega"] == pytest.approx(DISTURBED[1], rel=0.4)


@pytest.mark.parametrize(("state", "every"), [(0, 10)])
def test_a_state_that_is_measured_now_and_then_leaves_its_noise_to_be_found(state, every):
    trials = list(seen_every(swings(6, 200, 3), state, every))
    data = prepare(pendulum, trials)
    noise = HypothesisSearch(data, ()).nulls().noise
    assert np.exp(noise.log_q[1] / 2) == pytest.approx(DISTURBED[1], rel=0.3)
    assert np.exp(noise.floor[state] / 2) < 0.1 * DISTURBED[state]
    found = diagnose(pendulum, trials)
    assert found.kind == "none" and 0.85 < found.gap.after < 1.15


def test_the_start_goes_where_least_squares_over_the_whole_run_puts_it():
    trials = list(seen_every(swings(2, 12), 1, 0))
    data = prepare(pendulum, trials)
    rng = np.random.default_rng(0)
    L, B, n = 12, 2, 2
    F = np.array([[1.0, DT], [-0.3, 0.98]]) + 0.01 * rng.standard_normal((L, B, n, n))
    Q, R = np.array([1e-5, 1e-3]), np.full((L + 1, B, n), 1e-4)
    first = np.where(data.seen[0] > 0, R[0], prior(data))
    g = kalman.gains(kalman.LinearSystem(F, Q, R, data.seen, first))
    d, r = 0.01 * rng.standard_normal((L, B, n, 1)), 0.1 * rng.standard_normal((L + 1, B, n, 1))
    white, _ = kalman.innovations(g, d, r)
    found = smoothed(data, g, F, white[..., 0])
    for b in range(B):
        # unknowns e_0 ... e_L: prior of e_0, steps, the measured angle; all by one least squares
        size = n * (L + 1)
        rows, right = [], []
        first = [1e-4, prior(data)[1]]
        for i in range(n):
            row = np.zeros(size)
            row[i] = 1
            rows.append(row / np.sqrt(first[i]))
            right.append((r[0, b, 0, 0] if i == 0 else 0.0) / np.sqrt(first[i]))
        for t in range(L):
            for i in range(n):
                row = np.zeros(size)
                row[n * (t + 1) + i], row[n * t : n * t + n] = 1, -F[t, b, i]
                rows.append(row / np.sqrt(Q[i]))
                right.append(d[t, b, i, 0] / np.sqrt(Q[i]))
            row = np.zeros(size)
            row[n * (t + 1)] = 1
            rows.append(row / 1e-2)
            right.append(r[t + 1, b, 0, 0] / 1e-2)
        solved = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
        assert found[b, 0] == 0
        assert found[b, 1] == pytest.approx(solved[1], rel=1e-6)
