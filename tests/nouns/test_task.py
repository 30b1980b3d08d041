"""Task and reward: their checks, a hash of all that a utility depends on, the utility by hand."""

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
from small_tasks import cart, cart_task, other, rover_task

REWARD = Reward(np.array([10.0, 0.0]), np.zeros(2), np.array([0.01]), np.array([0.01]))
NAN = float("nan")
WRONG = {  # a field, what it may not be, and what the message names
    "dt": ([0.0, NAN, -0.1, "0.05"], ["dt"]),
    "start": ([np.zeros(3), np.array([NAN, 0.0])], ["start"]),
    "low": ([np.zeros(2), np.array([5.0]), np.array([NAN]), None], []),
    "past": ([np.array([9.0]), np.array([NAN])], ["before the start"]),
    "latency": ([np.array([-0.1]), np.array([2.6]), np.array([NAN])], ["latency of force"]),
    "target": ([np.zeros((1, 2)), np.zeros((0, 2)), None, np.zeros(41), np.zeros((2, 41))], []),
    "feedback": (["no"], ["feedback", "'no'"]),
    "input_target": ([np.zeros((41, 1))], ["input_target", "(40, 1)"]),
    "safety_low": ([np.array([1.0, 0.0])], ["[safety] x"]),
    "smoothing": ([-1.0], ["smoothing"]),
    "reward": ([{"x": 1.0}], ["reward", "dict"]),
    "model": ([cart_task], ["model", "function"]),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_does_not_fit_is_refused(name):
    values, named = WRONG[name]
    for value in values:
        with pytest.raises(GroundedError, match=holding(*named)):
            cart_task(**{"safety_high": np.array([-1.0, 1.0])} | {name: value})


def test_a_weighted_state_needs_a_target():
    target = np.array(cart_task().target)
    target[5, 0] = np.nan
    with pytest.raises(GroundedError, match=holding("x", "step 5")):
        cart_task(target=target)


HASHED = {
    "dt": 0.06,
    "feedback": False,
    "start": np.array([0.0, 0.1]),
    "past": np.array([0.1]),
    "low": np.array([-4.0]),
    "high": np.array([4.0]),
    "target": cart_task().target + 0.001,
    "reward": replace(REWARD, terminal=np.array([1.0, 0.0]), state=np.array([10.0, 0.0])),
    "input_target": np.full((40, 1), 0.1),
}


@pytest.mark.parametrize("name", HASHED)
def test_the_hash_changes_with_what_a_utility_depends_on(name):
    assert cart_task(**{name: HASHED[name]}).hash != cart_task().hash


def test_the_hash_stays_with_what_plans_only():
    task = cart_task()
    assert task.hash == cart_task().hash and len(task.hash) == 16
    assert task.with_model(other(cart)).hash == task.hash
    for change in (
        {"latency": np.array([0.1])},
        {"smoothing": 0.2},
        {"safety_low": np.array([-1.0, -1.0])},
    ):
        assert cart_task(**change).hash == task.hash


def test_an_open_loop_task_has_policies_without_gains():
    task = cart_task(feedback=False)
    made = task.policy(np.zeros((40, 1)), np.ones((40, 1, 3)), np.zeros((40, 3)))
    assert made.gain is None and made.reference is None


def test_nouns_with_arrays_are_shown_in_one_short_line():
    found = cart_task()
    policy = found.policy(np.zeros((found.horizon, found.model.m)), None, None)
    run = simulate(found.problem(), policy)
    for noun in (found, policy, run):
        shown = repr(noun)
        assert "\n" not in shown and len(shown) < 120, shown
        assert shown.startswith(f"{type(noun).__name__}(") and str(found.horizon) in shown


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
