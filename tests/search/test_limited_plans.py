"""A plan with a limit that is small in its unit makes full use of the limit."""

from dataclasses import replace

import numpy as np

from grounded.effects import Library, wrap
from grounded.model import Model, Param
from grounded.search.planner import planner_with, predicted
from grounded.task import Task
from grounded.utility import Reward

DT, STEPS = 0.05, 80


def rover() -> Model:
    """A robot driven by speed commands, in NumPy."""
    return Model(
        states={"x": "m", "y": "m", "psi": "rad", "v": "m/s", "w": "rad/s"},
        inputs={"linear": "m/s", "angular": "rad/s"},
        params={"lag": Param(0.12, "s", 0.05, 0.5)},
        angles=("psi",),
        derivative=lambda s, a, p: {
            "x": s.v * np.cos(s.psi),
            "y": s.v * np.sin(s.psi),
            "psi": s.w,
            "v": (a.linear - s.v) / p.lag,
            "w": (a.angular - s.w) / p.lag,
        },
    )


def task(model: Model) -> Task:
    """Acceleration at 0.5 m/s^2 up to 1 m/s, in a gentle turn."""
    t = DT * np.arange(STEPS + 1)
    v, w = np.minimum(0.5 * t, 1.0), 0.4 * np.sin(0.8 * t)
    psi = np.cumsum(w) * DT
    x, y = np.cumsum(v * np.cos(psi)) * DT, np.cumsum(v * np.sin(psi)) * DT
    return Task(
        model=model,
        dt=DT,
        target=np.column_stack([x, y, psi, v, w]),
        reward=Reward(
            np.array([1.0, 1.0, 1.0, 1.0, 0.0]), np.zeros(5), np.zeros(2), np.full(2, 0.01)
        ),
        start=np.zeros(5),
        past=np.zeros(2),
        low=np.array([-0.3, -1.8]),
        high=np.array([1.5, 1.8]),
    )


def test_a_limit_below_the_width_of_smoothing_is_planned_through():
    """A warehouse robot's first plan used 0.035 of a limit of 0.05: -85.6 in place of -0.004."""
    effects = [("rate_limit:linear", {"r": 0.7}), ("rate_limit:angular", {"r": 3.0})]
    effects.append(("delay:linear+angular", {"d": 0.128}))
    found = []
    for width in (0.05, 0.0):
        planner = planner_with(replace(task(rover()), smoothing=width), effects)
        policy, _ = planner.first_policy()
        found.append(predicted(planner.plan.problem(exact=True), policy).utility)
    assert 0.7 * DT < 0.05  # a step of the limit, the width
    assert found[0] > 1.02 * max(found) and found[0] > -0.25


def test_what_a_limit_takes_off_is_nothing_within_it():
    model = wrap(Library().effect("dead_zone:linear", rover()), {"c": 0.2}, DT)
    x = np.tile([0.0, 0.0, 0.0, 0.3, 0.0], (5, 1))
    u = np.column_stack([[-0.5, -0.1, 0.0, 0.2, 0.7], np.zeros(5)])
    plain = rover()
    left = np.column_stack([[-0.3, 0.0, 0.0, 0.0, 0.5], np.zeros(5)])
    want = plain.system.step(x, left, plain.values, DT)
    np.testing.assert_allclose(model.system.step(x, u, model.values, DT), want, atol=1e-15)
