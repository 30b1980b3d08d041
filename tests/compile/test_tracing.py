"""What can be traced is; what can't runs as it is, and says why and on which line."""

import math
from functools import partial
from math import sin as msin

import numpy as np
import pytest

from facts import holding
from grounded.compile import Named, system_of
from grounded.compile.names import Signature
from grounded.compile.run.differenced import DifferencedSystem
from grounded.errors import GroundedError
from problems import SPECS, system


def plain(function, states=("x", "v"), inputs=("f",), params=("m",), kind="derivative", **more):
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
        with pytest.raises(GroundedError, match=r"test_tracing\.py:\d+: .*\bx\b"):
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

    with pytest.raises(GroundedError, match=r"test_tracing.py:\d+: "):
        plain(dynamics).step(X, U, P, 0.1)


def test_function_that_does_not_broadcast_runs_sample_by_sample():
    def scalar(s, a, p):
        force = a.f if s.x > 0 else -math.sin(a.f)
        return {"x": s.v, "v": force / p.m}

    def vector(s, a, p):
        return {"x": s.v, "v": np.where(s.x > 0, a.f, -np.sin(a.f)) / p.m}

    assert np.allclose(
        plain(scalar).step(X, U, P, 0.1), plain(vector).step(X, U, P, 0.1), atol=1e-15
    )


def test_function_that_mixes_samples_up_is_found_out():
    def mixing(s, a, p):
        return {"x": s.v, "v": -np.linalg.norm([s.x, s.v]) * s.v + 0 * a.f}

    one = [plain(mixing).step(X[i : i + 1], U[i : i + 1], P, 0.1)[0] for i in range(2)]
    assert np.array_equal(plain(mixing).step(X, U, P, 0.1), one)


def test_black_box_step_with_any_callable():
    class Simulator:
        def __call__(self, s, a, p, dt):
            return {"x": s.x + dt * s.v, "v": s.v + dt * a.f / p.m}

    expected = X + 0.1 * np.column_stack([X[:, 1], U[:, 0] / 2.0])
    for function in (Simulator(), partial(Simulator().__call__)):
        assert np.allclose(plain(function, kind="step").step(X, U, P, 0.1), expected)


def test_derivatives_of_a_linear_model_are_exact():
    f, p = system("double_integrator", plain)
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
            plain(function).step(X[:rows], U[:rows], P, 0.1)
        assert "test_tracing.py:" in str(caught.value)


def test_what_leaves_the_finite_numbers_is_nan_not_raised():
    def overflow(s, a, p):
        return {"x": math.exp(1000 * s.x), "v": math.sqrt(a.f - 10.0)}

    assert np.isnan(plain(overflow).step(X[:1], U[:1], P, 0.1)).all()
    assert np.isnan(plain(overflow).step(np.full((1, 2), np.nan), U[:1], P, 0.1)).all()


G = 9.81
TABLE = np.array([[0.0, 1.0], [1.0, 3.0]])


def helper(x):
    return math.atan2(x, 2.0) + max(x, 0.1) + min(x, 0.2, 0.3)


def with_math(s, a, p):
    return {"x": math.sin(s.v) * math.pi + msin(s.x), "v": math.sqrt(1 + s.x**2) - G * p.c}


def with_helper(s, a, p):
    return {"x": helper(s.v) + helper(a.u), "v": abs(s.x) + float(a.u)}


def with_arrays(s, a, p):
    v = np.array([s.x, s.v])
    R = np.array([[np.cos(s.x), -np.sin(s.x)], [np.sin(s.x), np.cos(s.x)]])
    w = R @ v + 2 * np.sin(v) * a.u
    return {"x": w[0], "v": np.sum(w) + np.linalg.norm(v) + np.dot(v, w)}


def with_where(s, a, p):
    drag = np.where((s.v > 0) & ~(a.u < 0.5) | (s.x >= 1), p.c * s.v, np.sqrt(np.abs(s.v)))
    return {"x": drag, "v": np.clip(a.u, -0.5, 0.5) + np.sign(s.x) + np.minimum(s.v, p.c)}


def with_powers(s, a, p):
    return {"x": s.v**3 + 2**s.x + (1 + s.x**2) ** p.c, "v": (1 + s.v**2) ** -2 + (2 + a.u) ** 0.5}


def with_rounding(s, a, p):
    return {"x": (s.x + np.pi) % (2 * np.pi) - np.pi, "v": s.v // 1 + np.floor(s.x) + round(a.u)}


def with_loop(s, a, p):
    total = 0.0
    for i in range(5):
        total += np.tanh(s.x * i) / (i + 1)
    return {"x": total, "v": sum(c * s.v**i for i, c in enumerate((1.0, 2.0, 3.0)))}


def with_constants(s, a, p):
    return {"x": 0, "v": np.float64(1.5) * s.v + TABLE[1, 1]}


def with_everything_else(s, a, p):
    x = np.hypot(s.x, s.v) + np.log1p(s.x**2) + np.expm1(s.v) + np.cbrt(s.v) + np.arctan(s.x)
    y = (
        np.arcsin(np.tanh(s.x))
        + np.arccos(np.tanh(s.v))
        + np.sinh(s.x)
        + np.cosh(a.u)
        + np.square(a.u)
    )
    z = np.deg2rad(s.x) + np.log10(2 + s.x**2) + np.heaviside(s.x, 0.5) + np.copysign(s.v, s.x)
    return {"x": x + y, "v": z + np.arctan2(s.v, -1 - s.x**2) + np.tan(0.3 * s.x)}


class Car:
    gain = 2.0

    def rate(self, s, a, p):
        return {"x": self.gain * s.v, "v": math.cos(s.x) + a.u}


TRACED = [
    *(with_math, with_helper, with_arrays, with_where, with_powers, with_rounding, with_loop),
    *(with_constants, with_everything_else, Car().rate, partial(Car.rate, Car())),
]


def make(function, kind="derivative"):
    return system_of(function, kind=kind, states=("x", "v"), inputs=("u",), params=("c",))


def points(count=40, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 2)), rng.normal(size=(count, 1)), np.array([0.7])


@pytest.mark.filterwarnings("ignore:Bitwise inversion")  # of one bool; Python 3.12 says so
@pytest.mark.parametrize("function", TRACED, ids=lambda f: getattr(f, "__qualname__", "partial"))
def test_everyday_idioms_are_traced_and_mean_the_same(function):
    system = make(function)
    assert (system.how, system.note) == ("compiled", "")
    x, u, p = points()
    system.check(x, u, p, 0.1)
    plain = DifferencedSystem(Signature(function, "derivative", ("x", "v"), ("u",), ("c",)))
    mine, theirs = system.step(x, u, p, 0.1), plain.step(x, u, p, 0.1)
    assert np.allclose(mine, theirs, rtol=1e-12, atol=1e-12, equal_nan=True)


def if_on_a_state(s, a, p):
    if s.v > 0:
        return {"x": s.v, "v": a.u}
    return {"x": 0.0, "v": a.u}


def interpolates(s, a, p):
    return {"x": np.interp(s.v, TABLE[0], TABLE[1]), "v": a.u}


@pytest.mark.parametrize(
    ("function", "line", "why"),
    [(if_on_a_state, 1, "np.where"), (interpolates, 1, "interp")],
)
def test_what_cannot_be_traced_falls_back_and_names_the_line(function, line, why):
    system = make(function)
    assert system.how == "differenced"
    assert f"test_tracing.py:{function.__code__.co_firstlineno + line}" in system.note
    assert why in system.note


def test_fallback_still_gives_values_and_derivatives():
    system, (x, u, p) = make(if_on_a_state), points()
    x[0] = [0.0, 1.0]
    assert np.allclose(system.step(x, u, p, 0.1)[0, 0], 0.1 + 0.005 * u[0])
    f_x, f_u = system.linearise(x[:1], u[:1], p, 0.1)
    assert np.allclose(f_x[0], [[1, 0.1], [0, 1]]) and np.allclose(f_u[0], [[0.005], [0.1]])


def test_if_on_a_parameter_is_decided_by_its_value():
    def switched(s, a, p):
        if p.c > 0.5:
            return {"x": s.v, "v": a.u}
        return {"x": -s.v, "v": a.u * p.c}

    system, (x, u, _) = make(switched), points()
    assert system.how == "compiled"
    for c in (0.7, 0.2, 0.7, 0.3):
        p = np.array([c])
        system.check(x, u, p, 0.1)
        sign = 1 if c > 0.5 else -1
        rate = u[:, 0] * (1 if c > 0.5 else c)
        expected = x[:, 0] + sign * (0.1 * x[:, 1] + 0.005 * rate)
        assert np.allclose(system.step(x, u, p, 0.1)[:, 0], expected)
        assert np.allclose(
            system.sensitivities(x, u, p, 0.1)[2][:, 1, 0], 0 if c > 0.5 else 0.1 * u[:, 0]
        )


def test_mismatch_is_an_error_with_both_values():
    calls = []

    def forgetful(s, a, p):
        calls.append(1)
        return {"x": s.v * len(calls), "v": a.u}

    system, (x, u, p) = make(forgetful), points()
    with pytest.raises(GroundedError, match=r"test_tracing.py:\d+.*'x' .*\d.*\d"):
        system.check(x, u, p, 0.1)
