"""Plans with an adopted play, and policies that feed back older inputs than a new model's z has."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.search.planner import planner_with, predicted
from small_tasks import rover_task

LATE = ("delay:turn", {"d": 0.12})  # with TASK, 2.8 steps: without play, z has three past inputs
TASK = rover_task()


def with_play(width):
    return planner_with(TASK, [("backlash:turn", {"b": width}), LATE])


@pytest.fixture(scope="module")
def late():
    planner = planner_with(TASK, [LATE])
    return planner, planner.first_policy()[0]


def from_aside(planner, policy):
    """The predicted utility of a run that starts 0.2 m and 0.3 rad off."""
    problem = planner.plan.problem(exact=True)
    start = problem.start.copy()
    start[:3] += [0.1, -0.2, 0.3]
    return predicted(replace(problem, start=start), policy).utility


def test_a_model_with_less_latency_feeds_back_what_the_policy_does(late):
    planner, policy = late
    play = with_play(1e-9)
    assert policy.depths == (1, 3) and play.plan.problem().depths == (1, 2)
    assert np.abs(policy.gain[:, 1, -1]).max() > 0.05
    assert from_aside(play, policy) == pytest.approx(from_aside(planner, policy), rel=1e-3)
    wide = play.widened(policy)
    assert wide.depths == (1, 3) and (wide.gain[:, :, -1] == policy.gain[:, :, -1]).all()


def test_a_planner_remembers_what_earlier_policies_feed_back(late):
    planner, policy = late
    play = with_play(0.1)
    more = play.feeding_back([policy])
    assert more.plan.problem().depths == more.aim.problem().depths == (1, 3)
    assert more.fingerprint == play.fingerprint and more.plays == play.plays
    assert planner.feeding_back([policy]) is planner
