"""Gains for a model with adopted memory are stable with samples a fraction of a step old."""

import numpy as np
import pytest

from grounded.model import Model
from grounded.policy import Policy
from grounded.search.feedback import worse_costs
from grounded.search.improve import SearchOptions, propose
from grounded.search.planner import Planner, planner_with, predicted
from small_tasks import plain_task, speed_rover, speed_rover_task

LATE = [
    ("rate_limit:linear", {"r": 0.7}),
    ("rate_limit:angular", {"r": 3.0}),
    ("delay:linear+angular", {"d": 0.128}),
]


def joint(effects: list[tuple[str, dict[str, float]]], change: float) -> Planner:
    """A joint moved by 1 rad in half a second and held; `change` weights its torque's changes."""
    model = Model(
        states={"q": "rad", "w": "rad/s"},
        inputs={"tau": "N m"},
        params={},
        derivative=lambda s, a, p: {"q": s.w, "w": 10.0 * a.tau + 0.0 * s.q},
    )
    way = np.clip(0.02 * np.arange(101), 0.0, 1.0)
    target = np.column_stack([way * way * (3 - 2 * way), np.full(101, np.nan)])
    task = plain_task(model, 0.01, target, [1.0, 0.0], 5.0, change=change)
    return planner_with(task, effects)


@pytest.fixture(scope="module")
def planner():
    return planner_with(speed_rover_task(speed_rover()), LATE)


def made_by(planner: Planner) -> Policy:
    """The first candidate's."""
    made = propose(planner.task, [], [], SearchOptions(), planner=planner).candidate
    assert made is not None
    return made.policy


def test_gains_that_rely_on_fresh_samples_are_made_gentler():
    planner = joint([("delay:tau", {"d": 0.0148})], change=1e-7)
    problem = planner.plan.problem(exact=True)
    own, made = planner.narrowed(planner.first_policy()[0]), made_by(planner)
    assert worse_costs([problem], own).max() > 20 * worse_costs([problem], made).max()
    assert np.abs(made.gain).mean() < 0.7 * np.abs(own.gain).mean()
    runs = [predicted(problem, policy).utility for policy in (own, made)]
    assert runs[0] == pytest.approx(runs[1], rel=1e-6)  # the run itself stays


def test_gains_do_not_count_on_a_joint_that_sticks():
    """Without gains at standstill, an arm with dry friction spins once it slips."""
    effects = [
        ("delay:tau", {"d": 0.0148}),
        ("joint_friction:tau<-w", {"c": 0.3, "b": 0.02, "width": 0.005}),
    ]
    planner = joint([(name, {**values}) for name, values in effects], change=1e-6)
    problem = planner.plan.problem(exact=True)
    loose = planner.loosened(problem)
    assert loose is not None and (loose.p > 10 * problem.p).sum() == 1
    own, made = planner.narrowed(planner.first_policy()[0]), made_by(planner)
    its, mine = (worse_costs([problem, loose], policy) for policy in (own, made))
    assert np.log(mine).mean() <= np.log(its).mean() + 1e-9
    assert np.abs(made.gain[60:80, 0, 0]).min() > 0.1  # while it is to stand still
