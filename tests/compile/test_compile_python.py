"""The path that always works: any callable, differenced; and its errors."""

import math
from functools import partial

import numpy as np
import pytest

from facts import holding
from grounded.compile import Named
from grounded.compile.run.differenced import DifferencedSystem
from grounded.compile.trace.tracing import Signature
from grounded.errors import GroundedError
from problems import SPECS, system


def make(function, states=("x", "v"), inputs=("f",), params=("m",), kind="derivative", **more):
    return DifferencedSystem(Signature(function, kind, states, inputs, params), **more)


X, U, P = np.array([[1.0, 2.0], [-1.0, 0.5]]), np.array([[0.3], [0.1]]), np.array([2.0])


def test_names():
    s = Named("state", ("x", "v"), (1.0, 2.0))
    assert (s.x, s["v"], len(s), list(s), dict(s)) == (
        1.0,
        2.0,
        2,
        ["x", "v"],
        {"x": 1.0, "v": 2.0},
    )
    for ask in (lambda: s.velocity, lambda: s["velocity"], lambda: s[3]):
        with pytest.raises(GroundedError, match=r"test_compile_python\.py:\d+: .*\bx\b"):
            ask()
    with pytest.raises(GroundedError, match=holding("'x'")):
        s.x = 3.0
    assert not hasattr(s, "__array__")


@pytest.mark.parametrize(
    "rate",
    [lambda v, f: f - v, lambda v, f: 2 * v, lambda v, f: np.sin(v), lambda v, f: v + f],
    ids=["minus", "times", "sin", "plus"],
)
def test_values_unpacked_by_mistake_as_names(rate):

    def dynamics(s, a, p):
        _, v = s
        return {"x": s.v, "v": rate(v, a.f)}

    with pytest.raises(GroundedError, match=r"test_compile_python.py:\d+: "):
        make(dynamics).step(X, U, P, 0.1)


def test_function_that_does_not_broadcast_runs_sample_by_sample():
    def scalar(s, a, p):
        force = a.f if s.x > 0 else -math.sin(a.f)
        return {"x": s.v, "v": force / p.m}

    def vector(s, a, p):
        return {"x": s.v, "v": np.where(s.x > 0, a.f, -np.sin(a.f)) / p.m}

    assert np.allclose(make(scalar).step(X, U, P, 0.1), make(vector).step(X, U, P, 0.1), atol=1e-15)


def test_function_that_mixes_samples_up_is_found_out():
    def mixing(s, a, p):
        return {"x": s.v, "v": -np.linalg.norm([s.x, s.v]) * s.v + 0 * a.f}

    one = [make(mixing).step(X[i : i + 1], U[i : i + 1], P, 0.1)[0] for i in range(2)]
    assert np.array_equal(make(mixing).step(X, U, P, 0.1), one)


def test_black_box_step_with_any_callable():
    class Simulator:
        def __call__(self, s, a, p, dt):
            return {"x": s.x + dt * s.v, "v": s.v + dt * a.f / p.m}

    expected = X + 0.1 * np.column_stack([X[:, 1], U[:, 0] / 2.0])
    for function in (Simulator(), partial(Simulator().__call__)):
        assert np.allclose(make(function, kind="step").step(X, U, P, 0.1), expected)


def test_rk4_is_fourth_order_and_euler_first():
    def rate(s, a, p):
        return {"x": s.v, "v": -s.x}

    exact = np.array([math.cos(0.1), -math.sin(0.1)])
    x, u = np.array([[1.0, 0.0]]), np.zeros((1, 1))
    assert np.abs(make(rate).step(x, u, P, 0.1) - exact).max() < 1e-7
    assert np.allclose(make(rate, integrator="euler").step(x, u, P, 0.1), [[1.0, -0.1]])


def test_derivatives_of_a_linear_model_are_exact():
    f, p = system("double_integrator", make)
    x, u = np.random.default_rng(0).normal(size=(5, 2)), np.zeros((5, 1))
    f_x, f_u, f_p = f.sensitivities(x, u, p, 0.05)
    mass, drag = SPECS["double_integrator"]["params"].values()
    h = 0.05
    decay = sum((-drag * h) ** i / math.factorial(i) for i in range(5))
    assert np.allclose(f_x[:, 1, 1], decay, atol=1e-9)
    assert np.allclose(f_x[:, :, 0], [1.0, 0.0], atol=1e-9)
    assert np.allclose(f_u[:, 1, 0], (1 - decay) / drag / mass, atol=1e-9)
    assert np.allclose(f_p[:, 1, 0], 0.0, atol=1e-9)
    assert not np.allclose(f_p[:, 1, 1], 0.0, atol=1e-3)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda s, a, p: {"x": s.v + 1j, "v": a.f}, "state 'x'.*one real number.*complex"),
        (lambda s, a, p: {"x": s.v, "v": np.zeros(3)}, r"array of shape \(3,\)"),
        (lambda s, a, p: {"x": s.v, "v": None}, "NoneType"),
        (lambda s, a, p: {"x": s.v, "v": a.f + "1"}, "TypeError"),
    ],
)
def test_bad_models_name_their_file_and_line(function, message):
    for rows in (1, 2):
        with pytest.raises(GroundedError, match=message) as caught:
            make(function).step(X[:rows], U[:rows], P, 0.1)
        assert "test_compile_python.py:" in str(caught.value)


def test_what_leaves_the_finite_numbers_is_nan_not_raised():
    def overflow(s, a, p):
        return {"x": math.exp(1000 * s.x), "v": math.sqrt(a.f - 10.0)}

    assert np.isnan(make(overflow).step(X[:1], U[:1], P, 0.1)).all()
    assert np.isnan(make(overflow).step(np.full((1, 2), np.nan), U[:1], P, 0.1)).all()
