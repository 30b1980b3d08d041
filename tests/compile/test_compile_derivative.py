"""Exact derivatives against central differences, on expressions that Hypothesis makes up."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from grounded.compile import system_of
from grounded.compile.run.differenced import RELATIVE_STEP
from grounded.compile.run.traced import TracedSystem
from grounded.compile.trace.tracing import Signature, trace
from grounded.model import Model, Param
from problems import SPECS, system

UNARY = {
    "sin": np.sin,
    "cos": np.cos,
    "tanh": np.tanh,
    "atan": np.arctan,
    "exp": lambda x: np.exp(np.tanh(x)),
    "log": lambda x: np.log(1 + x * x),
    "sqrt": lambda x: np.sqrt(1 + x * x),
    "asin": lambda x: np.arcsin(0.9 * np.sin(x)),
    "acos": lambda x: np.arccos(0.9 * np.sin(x)),
    "tan": lambda x: np.tan(np.tanh(x)),
    "sinh": lambda x: np.sinh(np.tanh(x)),
    "expm1": lambda x: np.expm1(np.sin(x)),
    "log1p": lambda x: np.log1p(x * x),
    "cube": lambda x: np.tanh(x) ** 3,
    "power": lambda x: (2 + np.sin(x)) ** 1.7,
    "abs": np.abs,
    "sign": np.sign,
    "neg": lambda x: -x,
}
BINARY = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: np.sin(a) * np.cos(b),
    "div": lambda a, b: a / (1 + b * b),
    "atan2": lambda a, b: np.arctan2(a, 1.5 + np.sin(b)),
    "hypot": lambda a, b: np.hypot(a, 1 + b * b),
    "max": np.maximum,
    "min": np.minimum,
    "where": lambda a, b: np.where(a > b, np.sin(a), np.cos(b)),
    "and": lambda a, b: np.where((a > 0) & (b < 1), a, np.tanh(b)),
    "or": lambda a, b: np.where((a > 0) | ~(b >= 1), a, np.tanh(b)),
    "weight": lambda a, b: (a > b) * np.sin(b),
    "pow": lambda a, b: (2 + np.sin(a)) ** np.tanh(b),
}
LEAVES = ("s.x", "s.v", "a.u", "p.c", "p.d", "1.3")

trees = st.recursive(
    st.sampled_from(LEAVES),
    lambda inner: st.one_of(
        st.tuples(st.sampled_from(sorted(UNARY)), inner),
        st.tuples(st.sampled_from(sorted(BINARY)), inner, inner),
    ),
    max_leaves=8,
)


def evaluated(tree, s, a, p):
    if isinstance(tree, str):
        return {
            "s.x": lambda: s.x,
            "s.v": lambda: s.v,
            "a.u": lambda: a.u,
            "p.c": lambda: p.c,
            "p.d": lambda: p.d,
            "1.3": lambda: 1.3,
        }[tree]()
    if len(tree) == 2:
        return UNARY[tree[0]](evaluated(tree[1], s, a, p))
    return BINARY[tree[0]](evaluated(tree[1], s, a, p), evaluated(tree[2], s, a, p))


def model_of(left, right):
    def model(s, a, p):
        return {"x": evaluated(left, s, a, p), "v": evaluated(right, s, a, p)}

    return model


NAMES = {"states": ("x", "v"), "inputs": ("u",), "params": ("c", "d")}


def differenced(step, x, u, p):
    """Jacobian of step (N, n) with respect to x, u, p, by central differences."""
    both = np.hstack([x, u, np.tile(p, (len(x), 1))])
    columns = []
    for i in range(both.shape[1]):
        ends = []
        for side in (1, -1):
            moved = both.copy()
            moved[:, i] += side * RELATIVE_STEP
            ends.append(np.vstack([step(row[None, :2], row[None, 2:3], row[3:]) for row in moved]))
        columns.append((ends[0] - ends[1]) / (2 * RELATIVE_STEP))
    return np.stack(columns, axis=2)


@settings(max_examples=40, deadline=None)
@example("s.x", ("and", "s.x", ("add", ("and", "1.3", "1.3"), "s.x")), 0)  # an array without axes
@given(trees, trees, st.integers(0, 10_000))
def test_derivatives_of_made_up_expressions(left, right, seed):
    """Indicator terms with a width of 0.5, so that they have derivatives everywhere."""
    signature = Signature(model_of(left, right), "step_like", **NAMES)  # a derivative's arguments
    rng = np.random.default_rng(seed)
    x, u, p = rng.normal(size=(3, 2)), rng.normal(size=(3, 1)), rng.normal(size=2)
    found = trace(signature, p, 0.1)
    traced = TracedSystem(signature, found, "euler", "")
    traced.kind = "step"
    exact = np.concatenate(traced.sensitivities(x, u, p, 0.1, 0.5), axis=2)
    near = differenced(lambda *args: traced.step(*args, 0.1, 0.5), x, u, p)
    assert np.allclose(exact, near, rtol=1e-6, atol=1e-6 * (1 + np.abs(near).max()))


@settings(max_examples=6, deadline=None)
@given(trees, trees, st.integers(0, 10_000), st.sampled_from([0.0, 0.3]))
def test_compiled_agrees_with_interpreted(left, right, seed, eps):
    model = model_of(left, right)
    compiled = system_of(model, kind="derivative", integrator="rk4", **NAMES)
    signature = Signature(model, "derivative", **NAMES)
    rng = np.random.default_rng(seed)
    x, u, p = rng.normal(size=(11, 2)), rng.normal(size=(11, 1)), rng.normal(size=2)
    traced = TracedSystem(signature, trace(signature, p, 0.1), "rk4", "")
    assert compiled.how == "compiled"
    a, b = compiled.step(x, u, p, 0.1, eps), traced.step(x, u, p, 0.1, eps)
    assert np.allclose(a, b, rtol=1e-10, atol=1e-10)
    for mine, theirs in zip(
        compiled.sensitivities(x, u, p, 0.1, eps),
        traced.sensitivities(x, u, p, 0.1, eps),
        strict=True,
    ):
        assert np.allclose(mine, theirs, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", sorted(SPECS))
def test_models_against_central_differences(name, integrator="rk4"):
    made, p = system(name, integrator=integrator)
    rng = np.random.default_rng(1)
    x = rng.normal(size=(20, made.n)) * 0.4
    u = rng.uniform(0.3, 0.9, size=(20, made.m))
    exact = made.sensitivities(x, u, p, 0.05, 0.1)
    plain, _ = system(name, integrator=integrator)
    h = RELATIVE_STEP
    for which, size in ((0, made.n), (1, made.m), (2, made.k)):
        for i in range(size):
            ends = []
            for side in (h, -h):
                at = [x.copy(), u.copy(), p.copy()]
                at[which][..., i] += side
                ends.append(plain.step(*at, 0.05, 0.1))
            near = (ends[0] - ends[1]) / (2 * h)
            assert np.allclose(exact[which][:, :, i], near, atol=1e-6 * (1 + np.abs(near).max()))


def test_a_branch_not_taken_never_leaks_nan():
    def model(s, a, p):
        root = np.where(s.x > 0, np.sqrt(s.x), -s.x)
        inverse = np.where(s.v > 0.0, 1 / s.v, a.u)
        return {"x": root, "v": inverse + np.maximum(s.x, -np.inf)}

    made = system_of(model, kind="derivative", **NAMES)
    signature = Signature(model, "derivative", **NAMES)
    twin = TracedSystem(signature, trace(signature, None, 0.1), "rk4", "")
    x = np.array([[-1.0, -2.0], [1.0, 6.0], [-0.02, 8.0], [-0.5, -3.0]])
    for eps in (0.0, 0.1):
        u, p = np.ones((4, 1)), np.ones(2)
        for some in (made, twin):
            f_x, f_u = some.linearise(x[:3], u[:3], p, 1e-3, eps)
            if eps == 0.0:
                y = some.step(x[:, :], u, p, 1e-3, eps)
                assert np.isfinite(y[:3, 0]).all()
            assert np.isfinite(f_x[:, 0]).all() and np.isfinite(f_u[:, 0]).all()


@pytest.mark.parametrize("eps", [0.0, 0.05])
def test_what_is_infinitely_steep_at_rest_has_a_slope_there(eps):
    def drag(s, a, p):
        speed = np.hypot(s.x, s.v)
        return {
            "x": a.u - p.c * s.x * speed - np.sqrt(s.x**2 + s.v**2),
            "v": np.arctan2(s.v, s.x) + np.cbrt(s.v) + np.abs(s.x) ** 0.7 + np.arcsin(1 - s.x**2),
        }

    signature = Signature(drag, "derivative", **NAMES)
    twin = TracedSystem(signature, trace(signature, None, 0.1), "euler", "")
    x, u, p = np.zeros((1, 2)), np.ones((1, 1)), np.ones(2)
    for some in (system_of(drag, kind="derivative", integrator="euler", **NAMES), twin):
        f_x, f_u, f_p = some.sensitivities(x, u, p, 0.1, eps)
        np.testing.assert_array_equal(f_x[0], np.eye(2))
        np.testing.assert_allclose(f_u[0], [[0.1], [0.0]])
        np.testing.assert_array_equal(f_p[0], 0.0)
        away = some.linearise(np.array([[3.0, 4.0]]), u, p, 0.1, eps)[0][0]
        assert away[0, 1] == pytest.approx(-0.1 * (3 * 0.8 + 0.8))


def test_smoothing_narrows_to_the_exact_branch():
    made, p = system("car")
    x = np.array([[0.1, 0.5, 0.0, 0.0, 0.2]])
    u = np.array([[0.3, 0.6]])
    exact = made.step(x, u, p, 0.05, 0.0)
    errors = [
        np.abs(made.step(x, u, p, 0.05, eps) - exact).max() for eps in (0.1, 0.01, 1e-3, 1e-5)
    ]
    assert errors[0] > errors[1] > errors[-1] and errors[-1] < 1e-5


def test_what_depends_on_parameters_alone_is_never_smoothed():
    def lag(s, a, p, dt):
        tau = np.maximum(p.tau, 1e-6)
        sign = np.where(p.tau > 0.03, 1.0, -1.0)
        return {"y": s.y + sign * np.abs(p.tau) / tau * (1 - np.exp(-dt / tau)) * (a.u - s.y)}

    model = Model(states={"y": "1"}, inputs={"u": "1"}, params={"tau": Param(0.04)}, step=lag)
    x, u, p = np.array([[0.2]]), np.array([[1.0]]), np.array([0.04])
    exact = model.system.step(x, u, p, 0.02, 0.0)
    np.testing.assert_array_equal(model.system.step(x, u, p, 0.02, 0.05), exact)
    np.testing.assert_allclose(exact, 0.2 + (1 - np.exp(-0.5)) * 0.8)
    assert model.system.linearise(x, u, p, 0.02, 0.05)[1][0, 0, 0] == pytest.approx(
        1 - np.exp(-0.5)
    )
