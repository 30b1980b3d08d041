"""The derivatives of every built-in model, against central differences, and a loop too long."""

import numpy as np
import pytest

from grounded.errors import GroundedError
from grounded.experiments.figure8 import flight_task
from grounded.model import Model
from grounded.models import aircraft, car, pendulum
from grounded.search.first_guess import first_guess
from grounded.solve import ddp
from grounded.task import Task
from grounded.utility import Reward


def samples(model, rng):
    """States and inputs of ordinary operation, away from kinks by more than the differences."""
    if model is aircraft.model:
        guess = first_guess(flight_task(model))
        at = rng.choice(len(guess.inputs), 30, replace=False)
        return guess.z[at, : model.n], guess.inputs[at]
    if model is car.model:
        x = rng.uniform([-0.3, 0.3, -1, -1, -3, -2], [0.3, 1.2, 1, 1, 3, 2], (30, 6))
        u = np.column_stack([rng.uniform(0.2, 0.7, 30), rng.uniform(0.7, 0.9, 30)])
        return x, u
    return rng.uniform(-2, 2, (30, model.n)), rng.uniform(-2, 2, (30, model.m))


def differenced(f, v, h):
    """Fourth-order central differences of f (N, k) by each column of v (N, q)."""
    columns = []
    for j in range(v.shape[1]):
        step = np.zeros(v.shape[1])
        step[j] = h * (1 + abs(v[0, j]))
        near, far = f(v + step) - f(v - step), f(v + 2 * step) - f(v - 2 * step)
        columns.append((8 * near - far) / (12 * step[j]))
    return np.stack(columns, axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize("model", [car.model, pendulum.model, aircraft.model], ids=lambda m: m.name)
def test_derivatives_agree_with_central_differences(model):
    x, u = samples(model, np.random.default_rng(0))
    system, p, dt = model.system, model.values, 0.02
    assert system.how == "compiled" and system.note == ""
    f_x, f_u, f_p = system.sensitivities(x, u, p, dt)
    wanted = {
        "state": (f_x, differenced(lambda v: system.step(v, u, p, dt), x, 1e-4)),
        "input": (f_u, differenced(lambda v: system.step(x, v, p, dt), u, 1e-4)),
    }
    by_param = []
    for j, value in enumerate(p):
        h = 1e-4 * (abs(value) or 1.0)
        runs = []
        for k in (1, -1, 2, -2):
            q = np.array(p)
            q[j] += k * h
            runs.append(system.step(x, u, q, dt))
        by_param.append((8 * (runs[0] - runs[1]) - (runs[2] - runs[3])) / (12 * h))
    wanted["param"] = (f_p, np.stack(by_param, axis=-1))
    for name, (exact, difference) in wanted.items():
        scale = 1 + np.abs(exact).max(axis=(0, 2), keepdims=True)
        assert np.abs((exact - difference) / scale).max() < 1e-6, name


def endless(s, a, p):
    total = a.u
    for _ in range(30_000):
        total = np.sin(total) + a.u * s.x
    return {"x": total}


@pytest.mark.slow
def test_a_loop_that_unrolls_too_far_names_file_and_line():
    model = Model(states={"x": "m"}, inputs={"u": "1"}, derivative=endless)
    with pytest.raises(GroundedError, match=r"test_models_derivatives\.py:\d+: .*\bunrolls\b"):
        _ = model.system


@pytest.mark.parametrize("integrator", ["rk4", "euler"])
@pytest.mark.parametrize("which", ["constant", "input alone", "one state of many"])
def test_rates_that_depend_on_little(which, integrator):
    """A loop of a kernel runs at least once: empty Jacobians must not reach it."""

    def derivative(s, a, p):
        own = {"constant": 2.5, "input alone": a.u, "one state of many": s.x1}[which]
        return {"x0": 1.5, **{f"x{i}": 0.0 for i in range(2, 12)}, "x1": own}

    names = [f"x{i}" for i in range(12)]
    model = Model(
        states=dict.fromkeys(names, "1"),
        inputs={"u": "1"},
        derivative=derivative,
        integrator=integrator,
    )
    system, rng = model.system, np.random.default_rng(0)
    x, u = rng.normal(size=(11, 12)), rng.normal(size=(11, 1))
    f_x, f_u = system.linearise(x, u, model.values, 0.1)
    np.testing.assert_allclose(f_x[0][2:, 2:], np.eye(10))
    assert f_u[0, 1, 0] == pytest.approx(0.1 if which == "input alone" else 0.0)
    assert system.how == "compiled"
    weights = Reward(np.ones(12), np.zeros(12), np.ones(1), np.ones(1))
    bounds = {"low": np.array([-1.0]), "high": np.array([1.0])}
    task = Task(model, 0.1, np.zeros((21, 12)), weights, np.ones(12), np.zeros(1), **bounds)
    result = ddp.solve(task.problem(), np.zeros((20, 1)))
    assert np.isfinite(result.cost) and np.isfinite(result.K).all()
