"""Logs of a balancing robot that fell: its motor was at its limits nearly all the time.

Commands at the limits follow from most policies, so few samples tell where a run begins and what a
program passed to its candidate.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from grounded import Model
from grounded.policy import Policy
from grounded_trials.logs.signals import Series, SignalSpec
from grounded_trials.workspace.intake.opening.run_start import recording
from grounded_trials.workspace.intake.recognise import stories_of_log
from small_tasks import plain_task

DT, STEPS, WAITS, LIMIT, NAMES = 0.01, 300, 150, 7.4, (("tilt", "rate"), ("voltage",))
HAND = np.array([38.0, 4.0])


def candidate(gain, seed=1, name="c0003"):
    """A policy whose plan and gains change from step to step."""
    rng, k = np.random.default_rng(seed), np.arange(STEPS)
    plan = 0.8 * np.sin(0.05 * k + rng.uniform(0, 6))[:, None]
    gains = np.zeros((STEPS, 1, 3))
    gains[:, 0, :2] = np.asarray(gain) * (1 + 0.2 * np.sin(0.03 * k))[:, None]
    limit, none = np.array([LIMIT]), np.zeros(1)
    reference = np.zeros((STEPS, 3))
    reference[:, 0] = 0.03 * np.sin(0.07 * k)
    policy = Policy(plan, -limit, limit, DT, *NAMES, (1,), (False,) * 2, none, gains, reference)
    predicted = np.stack([reference[:, 0], np.gradient(reference[:, 0], DT)], axis=1)
    return SimpleNamespace(
        id=name, policy=policy, predicted_states=np.vstack([predicted, predicted[-1:]])
    )


def balanced(ran, seed=0, factor=1.0, after=100):
    """Balance by hand for 1.5 s, then by a policy with late commands and a loop that jitters."""
    rng, queue, u = np.random.default_rng(seed), [], 0.0
    x, now, rows = np.array([0.0, 0.0]), 0.0, []
    for k in range(WAITS + STEPS + after):
        t = k * DT + abs(rng.normal(0, 0.0008))
        while now < t:
            while queue and queue[0][0] <= now:
                u = queue.pop(0)[1]
            fell = abs(x[0]) > 0.9
            x = np.array([np.sign(x[0]) * 0.95, 0.0]) if fell else x + 5e-4 * acceleration(x, u)
            now += 5e-4
        felt = x + rng.normal(0, (0.0015, 0.01))
        step = k - WAITS
        if 0 <= step < STEPS:
            one = ran.policy
            sent = one.feedforward[step, 0]
            sent += one.gain[step, 0, :2] @ (factor * felt - one.reference[step, :2])
        else:
            sent = HAND @ felt
        sent = float(np.clip(sent, -LIMIT, LIMIT))
        queue.append((t + 0.025, sent))
        rows.append((t, *felt, sent))
    return np.array(rows)


def acceleration(x, u):
    return np.array([x[1], 45 * np.sin(x[0]) - 9 * u])


def log_of(rows):
    """Return a task and the recording of rows whose commands have stamps of their own."""

    def logged(values, late):
        t = np.round(1e9 * (1000 + rows[:, 0] + late)).astype(np.int64)
        return Series(SignalSpec("/a.b"), t, values, t, len(t), "")

    series = {
        "tilt": logged(rows[:, 1], 0.0),
        "rate": logged(rows[:, 2], 0.0),
        "voltage": logged(rows[:, 3], 0.0006),
    }
    model = Model(
        states={"tilt": "rad", "rate": "rad/s"},
        inputs={"voltage": "V"},
        params={},
        derivative=lambda s, a, p: {"tilt": s.rate, "rate": 45 * np.sin(s.tilt) - 9 * a.voltage},
    )
    late = {"effort": 0.01, "latency": np.array([0.025])}
    task = plain_task(model, DT, np.zeros((STEPS + 1, 2)), [1.0, 0.1], LIMIT, **late)
    return task, recording(series, task, series)


def test_a_run_at_its_limits_begins_where_its_few_other_commands_are_exact(seed=1):
    ran = candidate(30 * HAND)
    rows = balanced(ran, seed)
    assert np.mean(np.abs(rows[WAITS : WAITS + STEPS, 3]) < LIMIT) < 0.05
    _, log = log_of(rows)
    found = log.start_of(ran.policy)
    assert found.alike and found.exact
    assert found.seconds == pytest.approx(WAITS * DT, abs=0.004)
    assert found.loose_s == 0.0 and found.rival_s is None  # each command has its own stamp


@pytest.mark.parametrize("seed", [0, 3])
def test_another_policy_at_its_limits_is_no_misuse(seed):
    ran, own = candidate(6 * HAND, 2), candidate((2 + 0.5 * seed) * HAND, 3)
    task, log = log_of(balanced(ran, seed))
    assert not stories_of_log(log, task, own, None)
