"""The start of DDP and first plans: goals that sensors see late, small limits, play, trim."""

from dataclasses import replace

import numpy as np
import pytest

import grounded as gr
from grounded.experiments.car_tasks import NAMES, car_task
from grounded.experiments.figure8 import flight_task
from grounded.experiments.pendulum import pendulum_task
from grounded.models import aircraft, car, pendulum
from grounded.search.first_guess import first_guess, trim
from grounded.search.first_policy import first_policy
from grounded.search.planner import planner_with, predicted
from grounded.solve import ddp
from small_tasks import DT, cart, cart_task, plain_task, rover_task, speed_rover, speed_rover_task

TASKS = {
    **{f"car {name}": (lambda name=name: car_task(name, car.model), 25.0) for name in NAMES},
    "pendulum": (lambda: pendulum_task(pendulum.model), 3.0),
    "aircraft": (lambda: flight_task(aircraft.model), 3.0),
    "cart": (cart_task, 3.5),
    "rover": (rover_task, 3.0),
}


@pytest.mark.parametrize("name", TASKS)
def test_the_guess_is_finite_and_ddp_is_near_from_it(name):
    make, factor = TASKS[name]
    task = make()
    guess = first_guess(task)
    policy, result = first_policy(task)
    assert np.isfinite(guess.cost) and result.status in ("converged", "max iterations")
    assert result.cost <= guess.cost < factor * result.cost
    assert (policy.feedforward >= task.low - 1e-12).all()
    assert (policy.feedforward <= task.high + 1e-12).all()
    nothing = ddp.solve(
        task.problem(), np.tile(np.clip(task.past, task.low, task.high), (task.horizon, 1))
    )
    assert not result.cost > 1.05 * nothing.cost  # zero inputs lead to nothing better


def no_plan(**function):
    """Return the error for a model that is not finite at the start."""
    nothing = {"states": {"x": "m", "v": "m/s"}, "inputs": {"a": "m/s^2"}}
    target, weights = [[0.0, np.nan]] + 10 * [[1.0, np.nan]], [1.0, 0.0]
    model = gr.Model(**nothing, **function)
    task = plain_task(model, 0.1, target, weights, 1.0, terminal=weights, effort=0.1)
    with pytest.raises(gr.GroundedError, match="there is no plan to run") as raised:
        gr.Search(task).ask()
    return str(raised.value)


def test_a_model_without_a_number_is_told_with_its_line():
    def dynamics(s, a, p):
        root = np.sqrt(s.v - 0.5)
        return {"x": s.v, "v": a.a - root}

    line = dynamics.__code__.co_firstlineno + 1
    told = no_plan(derivative=dynamics)
    assert f"test_first_policy.py:{line}: invalid value encountered in sqrt" in told

    def nothing(s, a, p):
        return {"x": s.v, "v": a.a + np.where(s.x < 0.01, np.nan, 0.0)}

    told = no_plan(derivative=nothing)
    assert f"test_first_policy.py:{nothing.__code__.co_firstlineno}: nan for 'v'" in told


def test_a_derivative_without_a_number_is_told_by_its_names():
    def step(s, a, p, dt):
        return {"x": s.x + dt * s.v, "v": s.v + dt * a.a}

    def slopes(s, a, p, dt):
        return np.array([[1, dt], [0, 1]]), np.array([[0], [np.nan]])

    told = no_plan(step=step, jacobian=slopes)
    assert "derivative of state 'v' by 'a' is not finite at 0 s" in told
    assert "test_first_policy.py" in told


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
    assert more.plan.problem().depths == more.engaged.problem().depths == (1, 3)
    assert more.fingerprint == play.fingerprint and more.plays == play.plays
    assert planner.feeding_back([policy]) is planner


def test_a_cart_that_follows_a_known_motion_needs_the_force_of_newton():
    task = cart_task()
    t = 0.05 * np.arange(41)
    x = np.column_stack([1 - np.cos(t), np.sin(t)])
    _, u = trim(task, x, np.array([True, True]))
    np.testing.assert_allclose(u[:, 0], (np.cos(t) + 0.2 * np.sin(t))[:-1], atol=0.1)
    moved = cart.system.step(x[:-1], u, cart.values, 0.05)
    assert np.abs(moved - x[1:]).max() < 2e-3
