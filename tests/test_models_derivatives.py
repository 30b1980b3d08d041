"""The derivatives of every built-in model, against central differences, and a loop too long."""

import numpy as np
import pytest

from grounded.errors import GroundedError
from grounded.experiments.figure8 import flight_task
from grounded.first_guess import first_guess
from grounded.model import Model
from grounded.models import aircraft, car, pendulum


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


def test_the_compiled_model_is_the_users_function():
    for model in (car.model, pendulum.model, aircraft.model):
        x, u = samples(model, np.random.default_rng(1))
        model.system.check(x, u, model.values, 0.02)


def endless(s, a, p):
    total = a.u
    for _ in range(30_000):
        total = np.sin(total) + a.u * s.x
    return {"x": total}


def test_a_loop_that_unrolls_too_far_names_file_and_line():
    model = Model(states={"x": "m"}, inputs={"u": "1"}, derivative=endless)
    with pytest.raises(GroundedError, match=r"test_models_derivatives\.py:\d+: it unrolls to more"):
        _ = model.system
