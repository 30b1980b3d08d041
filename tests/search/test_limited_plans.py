"""A plan with a limit that is small in its unit makes full use of the limit."""

from dataclasses import replace

from grounded.search.planner import planner_with, predicted
from small_tasks import DT, speed_rover, speed_rover_task


def test_a_limit_below_the_width_of_smoothing_is_planned_through():
    """A warehouse robot's first plan used 0.035 of a limit of 0.05: -85.6 in place of -0.004."""
    effects = [("rate_limit:linear", {"r": 0.7}), ("rate_limit:angular", {"r": 3.0})]
    effects.append(("delay:linear+angular", {"d": 0.128}))
    found = []
    for width in (0.05, 0.0):
        planner = planner_with(replace(speed_rover_task(speed_rover()), smoothing=width), effects)
        policy, _ = planner.first_policy()
        found.append(predicted(planner.plan.problem(exact=True), policy).utility)
    assert 0.7 * DT < 0.05  # a step of the limit, the width
    assert found[0] > 1.02 * max(found) and found[0] > -0.25
