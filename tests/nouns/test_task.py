"""Task: its checks, and a hash of everything that a utility depends on."""

import time
from dataclasses import replace

import numpy as np
import pytest

from facts import holding
from grounded.errors import GroundedError
from grounded.model import Model
from grounded.rollout import simulate
from grounded.utility import Reward
from pace import slowness
from small_tasks import cart, cart_task, other, rover_task

REWARD = Reward(np.array([10.0, 0.0]), np.zeros(2), np.array([0.01]), np.array([0.01]))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"dt": 0.0}, "dt must be a positive"),
        ({"dt": np.nan}, "dt must be a positive"),
        ({"dt": -0.1}, "dt must be a positive"),
        ({"start": np.zeros(3)}, r"start must have shape \(2,\), got \(3,\)"),
        ({"start": np.array([np.nan, 0.0])}, "start state must be finite"),
        ({"low": np.zeros(2)}, r"low must have shape \(1,\)"),
        (
            {"low": np.array([5.0])},
            r"\[limits\] force: the lower limit 5 must be below the upper limit 5",
        ),
        ({"low": np.array([np.nan])}, r"\[limits\] force"),
        ({"past": np.array([9.0])}, r"force = 9 N is held before the start, outside its limits"),
        (
            {"latency": np.array([-0.1])},
            r"latency of force must be 0 to 50 control steps \(2.5 s\)",
        ),
        ({"latency": np.array([2.6])}, "latency of force"),
        ({"latency": np.array([np.nan])}, "latency of force"),
        ({"target": np.zeros((1, 2))}, "horizon must be 1 to"),
        ({"feedback": "no"}, "feedback must be True or False, got 'no'"),
        ({"target": np.zeros((0, 2))}, "horizon must be 1 to"),
        ({"input_target": np.zeros((41, 1))}, r"input_target must have shape \(40, 1\)"),
        (
            {"safety_low": np.array([1.0, 0.0]), "safety_high": np.array([-1.0, 1.0])},
            r"\[safety\] x",
        ),
        ({"smoothing": -1.0}, "smoothing"),
        ({"dt": "0.05"}, "dt must be a positive"),
        ({"target": None}, r"target must have shape \(H \+ 1, 2\)"),
        ({"target": np.zeros(41)}, r"target must have shape \(H \+ 1, 2\)"),
        ({"target": np.zeros((2, 41))}, "transpose"),
        ({"low": None}, "low must have shape.*infinite"),
        ({"reward": {"x": 1.0}}, "reward must be a Reward, got a dict"),
        ({"model": cart_task}, "model must be a Model, got a function"),
        ({"past": np.array([np.nan])}, "held before the start"),
    ],
    ids=lambda v: next(iter(v)) if isinstance(v, dict) else str(v)[:45],
)
def test_what_does_not_fit_is_refused(change, match):
    with pytest.raises(GroundedError, match=match):
        cart_task(**change)


def test_a_weighted_state_needs_a_target():
    target = np.array(cart_task().target)
    target[5, 0] = np.nan
    with pytest.raises(GroundedError, match=holding("'x'", "step 5")):
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


def test_the_problem_is_exact_or_smoothed():
    task = rover_task()
    assert task.problem().smoothing == 0.05 and task.problem(exact=True).smoothing == 0.0
    assert task.problem().delay.tolist() == pytest.approx([1.0, 0.4])
    assert task.problem().depths == (1, 1) and task.problem().nz == 5
    weight = task.problem().state_weight
    np.testing.assert_array_equal(weight[-1] - weight[0], np.ones(3))


def test_an_open_loop_task_has_policies_without_gains():
    task = cart_task(feedback=False)
    made = task.policy(np.zeros((40, 1)), np.ones((40, 1, 3)), np.zeros((40, 3)))
    assert made.gain is None and made.reference is None


def test_a_model_of_a_thousand_states_is_refused_at_once():
    names = [f"x{i}" for i in range(1000)]
    states = dict.fromkeys(names, "m")
    began = time.process_time()
    with pytest.raises(GroundedError, match=holding(1000, 200)):
        Model(states, {"force": "N"}, step=lambda s, a, p, dt: states)
    assert time.process_time() - began < slowness()


def test_nouns_with_arrays_are_shown_in_one_short_line():
    found = cart_task()
    policy = found.policy(np.zeros((found.horizon, found.model.m)), None, None)
    run = simulate(found.problem(), policy)
    for noun in (found, policy, run):
        shown = repr(noun)
        assert "\n" not in shown and len(shown) < 120, shown
        assert shown.startswith(f"{type(noun).__name__}(") and str(found.horizon) in shown
