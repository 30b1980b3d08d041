"""Gains of a model with adopted memory hold on samples that are a part of a control step old."""

from dataclasses import replace

import numpy as np
import pytest
from test_limited_plans import rover, task

from grounded.search.improve import SearchOptions, propose
from grounded.search.making import Maker
from grounded.search.margin import OLD, costs_of, holds
from grounded.search.planner import planner_with, predicted
from grounded.search.standing import standing

LATE = [
    ("rate_limit:linear", {"r": 0.7}),
    ("rate_limit:angular", {"r": 3.0}),
    ("delay:linear+angular", {"d": 0.128}),
]


@pytest.fixture(scope="module")
def planner():
    return planner_with(task(rover()), LATE)


def test_fresh_samples_give_the_predicted_run(planner):
    problem, (policy, _) = planner.plan.problem(exact=True), planner.first_policy()
    want = -predicted(problem, planner.narrowed(policy)).utility
    assert costs_of(problem, planner.narrowed(policy), np.array([0.0]))[0] == pytest.approx(
        want, rel=1e-9
    )


def test_the_first_policy_of_a_late_model_holds_on_old_samples(planner):
    """A warehouse robot's was predicted at -0.003 and ran at -5.6: its loop had no margin."""
    problem = planner.plan.problem(exact=True)
    own, _ = planner.first_policy()
    made = propose(planner.task, [], [], SearchOptions(), planner=planner).candidate
    assert made is not None and holds(problem, made.policy)
    fresh = costs_of(problem, made.policy, np.array([0.0]))[0]
    assert fresh == pytest.approx(-made.predicted_utility, rel=1e-6)
    assert fresh < 1.01 * costs_of(problem, planner.narrowed(own), np.array([0.0]))[0]
    mine, its = (
        costs_of(problem, p, np.array([OLD]))[0] for p in (made.policy, planner.narrowed(own))
    )
    assert mine <= its


def test_a_policy_of_the_task_s_own_model_is_as_it_was():
    """Nothing was adopted: no run is simulated, and the same trials give the same candidate."""
    plain = planner_with(task(rover()), [])
    own, _ = plain.first_policy()
    made = propose(plain.task, [], [], SearchOptions(), planner=plain).candidate
    np.testing.assert_array_equal(made.policy.gain, plain.narrowed(own).gain)


def test_a_command_at_its_limit_tells_nothing_of_what_no_sensor_shows():
    """A gain on it, of rounding by rounding, reached 1e27, and the plan was refused for it."""
    plain = task(rover())
    reward = replace(plain.reward, input_change=np.array([0.01, 0.003]))
    slow = replace(plain, low=np.array([-0.3, -0.3]), high=np.array([1.5, 0.3]), reward=reward)
    planner = planner_with(slow, LATE)
    policy, plan = planner.first_policy()
    assert np.isclose(np.abs(plan.u[:, 1]), 0.3).sum() > 5
    now = standing(slow, [], [], SearchOptions(), planner.fingerprint)
    maker, problem = Maker(planner, now, "c0001", ""), planner.plan.problem(exact=True)
    for caution in (0.5, 1.0, 1.5):
        gentle = maker._gently(planner.narrowed(policy), problem, caution)
        assert np.abs(gentle.gain).max() < 10.0
