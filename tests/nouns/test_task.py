"""Task: its checks, and a hash of everything that a utility depends on."""

from dataclasses import replace

import numpy as np
import pytest

from facts import holding
from grounded.errors import GroundedError
from grounded.rollout import simulate
from grounded.utility import Reward
from small_tasks import cart, cart_task, other

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
