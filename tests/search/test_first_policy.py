"""The start of DDP: a closed-loop run near the target, for every manoeuvre."""

import numpy as np
import pytest

import grounded as gr
from grounded.experiments.car_tasks import NAMES, car_task
from grounded.experiments.figure8 import flight_task
from grounded.experiments.pendulum import pendulum_task
from grounded.models import aircraft, car, pendulum
from grounded.search.first_guess import first_guess
from grounded.search.first_policy import first_policy
from grounded.solve import ddp
from small_tasks import cart_task, rover_task

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
    task = gr.Task(
        model=gr.Model(**nothing, **function),
        dt=0.1,
        target=np.array([[0.0, np.nan]] + 10 * [[1.0, np.nan]]),
        reward=gr.Reward(state=[1.0, 0.0], terminal=[1.0, 0.0], input=[0.1], input_change=[0.0]),
        start=np.zeros(2),
        past=np.zeros(1),
        low=-np.ones(1),
        high=np.ones(1),
    )
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
