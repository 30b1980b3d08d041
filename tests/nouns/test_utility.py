"""The quadratic reward against a computation by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from facts import holding
from grounded.errors import GroundedError
from grounded.rollout import simulate
from grounded.solve.bias import ground
from grounded.trial import Trial
from grounded.utility import Reward, step_rewards
from small_tasks import cart_task, rover_task


def by_hand(task, trial):
    """- sum W (s - target)^2 + R (a - a_target)^2 + S (a_t - a_{t-1})^2, in plain loops."""
    names, total = task.model.state_names, 0.0
    held = task.past if trial.start_inputs is None else trial.start_inputs
    for t in range(trial.steps + 1):
        for i, name in enumerate(names):
            if math.isnan(task.target[t, i]):
                continue
            d = trial.states[t, i] - task.target[t, i]
            if name in task.model.angles:
                d = math.atan2(math.sin(d), math.cos(d))
            weight = task.reward.state[i]
            if t == task.horizon:
                weight += task.reward.terminal[i]
            total -= weight * d * d
    for t in range(trial.steps):
        for j in range(task.model.m):
            before = held[j] if t == 0 else trial.inputs[t - 1, j]
            now = trial.inputs[t, j]
            total -= task.reward.input[j] * (now - task.input_target[t, j]) ** 2
            total -= task.reward.input_change[j] * (now - before) ** 2
    return total


def random_trial(task, seed=0, **changes):
    rng = np.random.default_rng(seed)
    H, n, m = task.horizon, task.model.n, task.model.m
    return Trial(
        states=10 * rng.normal(size=(H + 1, n)),
        inputs=rng.normal(size=(H, m)),
        dt=task.dt,
        state_names=task.model.state_names,
        input_names=task.model.input_names,
        **changes,
    )


@pytest.mark.parametrize("make", [cart_task, rover_task])
def test_utility_by_hand(make):
    task = make()
    task = replace(
        task, input_target=np.random.default_rng(1).normal(size=(task.horizon, task.model.m))
    )
    for seed in range(5):
        trial = random_trial(task, seed)
        assert task.utility(trial) == pytest.approx(by_hand(task, trial), rel=1e-12)
        assert task.rewards(trial).shape == (task.horizon + 1,)
        assert (task.rewards(trial) <= 0).all()


def test_the_input_held_before_the_start_is_the_trials():
    task = cart_task()
    plain, held = random_trial(task), random_trial(task, start_inputs=np.array([3.0]))
    assert task.utility(held) == pytest.approx(by_hand(task, held), rel=1e-12)
    assert task.utility(held) != task.utility(plain)


def test_the_model_judges_as_reality_does():
    task = rover_task()
    u = np.clip(np.random.default_rng(2).normal(size=(60, 2)), task.low, task.high)
    run = simulate(task.problem(exact=True), task.policy(u, None, None))
    trial = Trial(run.states, run.inputs, task.dt, ("x", "y", "psi"), ("speed", "turn"))
    assert run.utility == pytest.approx(task.utility(trial), rel=1e-12)


def test_short_and_unfinite_trials_have_no_utility():
    task = cart_task()
    whole = random_trial(task)
    cut = replace(whole, states=whole.states[:31], inputs=whole.inputs[:30])
    assert task.utility(cut) == -np.inf
    assert task.rewards(cut).shape == (31,) and np.isfinite(task.rewards(cut)).all()
    for where in (0, 17, 40):
        states = np.array(whole.states)
        states[where] = np.nan
        assert task.utility(replace(whole, states=states)) == -np.inf
    inputs = np.array(whole.inputs)
    inputs[39] = np.inf
    assert task.utility(replace(whole, inputs=inputs)) == -np.inf


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf])
def test_weights_are_finite_and_not_negative(bad):
    with pytest.raises(GroundedError, match=holding("[reward] input")):
        Reward(np.ones(2), np.zeros(2), np.array([bad]), np.zeros(1))


def test_a_change_is_paid_where_it_happens():
    reward = Reward(np.zeros(1), np.zeros(1), np.zeros(1), np.array([2.0]))
    u = np.array([[0.0], [0.0], [3.0], [3.0]])
    found = step_rewards(reward, np.zeros((5, 1)), u, np.zeros((4, 1)), np.zeros(1))
    np.testing.assert_array_equal(found, [0, 0, -18, 0, 0])


def test_what_follows_the_horizon_is_not_judged():
    task = cart_task()
    whole = random_trial(task)
    longer = replace(
        whole,
        states=np.vstack([whole.states, np.full((3, 2), np.nan)]),
        inputs=np.vstack([whole.inputs, np.full((3, 1), 9.0)]),
    )
    assert task.utility(longer) == task.utility(whole)
    np.testing.assert_array_equal(ground(task, longer).bias, ground(task, whole).bias)
