"""Exact derivatives against central differences: expressions, models, substeps, own Jacobians."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from facts import holding
from grounded.compile import Named, system_of
from grounded.effects import Library, wrap
from grounded.errors import GroundedError
from grounded.experiments.figure8 import flight_task
from grounded.model import Model, Param
from grounded.models import aircraft, car, pendulum
from grounded.search.first_guess import first_guess
from grounded.solve import ddp
from small_tasks import plain_task
from stepped import slopes

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
        of, _, name = tree.partition(".")
        return 1.3 if of == "1" else getattr({"s": s, "a": a, "p": p}[of], name)
    if len(tree) == 2:
        return UNARY[tree[0]](evaluated(tree[1], s, a, p))
    return BINARY[tree[0]](evaluated(tree[1], s, a, p), evaluated(tree[2], s, a, p))


def model_of(left, right):
    def model(s, a, p):
        return {"x": evaluated(left, s, a, p), "v": evaluated(right, s, a, p)}

    return model


SPACE = {"states": ("x", "v"), "inputs": ("u",), "params": ("c", "d")}


def by_all(step, x, u, p, size=1e-6):
    """Central differences of step (N, n) by x, u and p."""
    return (
        slopes(lambda v: step(v, u, p), x, size),
        slopes(lambda v: step(x, v, p), u, size),
        slopes(lambda v: step(x, u, v), p, size * np.maximum(np.abs(p), size)),
    )


@settings(max_examples=8, deadline=None)
@example("s.x", ("and", "s.x", ("add", ("and", "1.3", "1.3"), "s.x")), 0)  # an array without axes
@given(trees, trees, st.integers(0, 10_000))
def test_made_up_expressions_are_those_of_the_function_and_differentiated(left, right, seed):
    """Derivatives with a width of 0.5, so that indicator terms have them everywhere."""
    model = model_of(left, right)
    made = system_of(lambda s, a, p, dt: model(s, a, p), kind="step", **SPACE)
    rng = np.random.default_rng(seed)
    x, u, p = rng.normal(size=(11, 2)), rng.normal(size=(11, 1)), rng.normal(size=2)
    assert made.how == "compiled"
    columns = zip(SPACE.items(), (x.T, u.T, p), strict=True)
    own = model(*(Named(what, names, [*values]) for (what, names), values in columns))
    own = np.column_stack([np.broadcast_to(own[name], 11) for name in SPACE["states"]])
    np.testing.assert_allclose(made.step(x, u, p, 0.1), own, rtol=1e-10, atol=1e-10)
    exact = made.sensitivities(x, u, p, 0.1, 0.5)
    for found, near in zip(
        exact, by_all(lambda *at: made.step(*at, 0.1, 0.5), x, u, p), strict=True
    ):
        assert np.allclose(found, near, rtol=1e-6, atol=1e-6 * (1 + np.abs(near).max()))


def test_smoothed_terms_are_their_formulas():
    terms = {
        "where": (lambda x, y: np.where(x > y, x, 2.0), lambda x, y, w, r: w * x + (1 - w) * 2.0),
        "abs": (lambda x, y: np.abs(x - y), lambda x, y, w, r: r),
        "sign": (lambda x, y: np.sign(x - y), lambda x, y, w, r: (x - y) / r),
        "max": (np.maximum, lambda x, y, w, r: 0.5 * (x + y + r)),
        "and": (lambda x, y: (x > y) & ~(x > y), lambda x, y, w, r: w * (1 - w)),
        "or": (lambda x, y: (x > y) | (y > x), lambda x, y, w, r: 1 - w * (1 - w)),
    }

    def step(s, a, p, dt):
        return {name: term(s["where"], s["abs"]) for name, (term, _) in terms.items()}

    made = system_of(step, kind="step", states=terms, inputs=("u",), params=())
    x = np.random.default_rng(0).normal(size=(9, 6))
    for eps in (0.03, 0.5, 1e-5):
        one, other = x[:, 0], x[:, 1]
        with np.errstate(over="ignore"):
            w = 1 / (1 + np.exp(-(one - other) / eps))
        root = np.sqrt((one - other) ** 2 + eps**2)
        expected = np.column_stack([by(one, other, w, root) for _, by in terms.values()])
        found = made.step(x, np.zeros((9, 1)), np.zeros(0), 0.1, eps)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)


def test_a_branch_not_taken_never_leaks_nan():
    def model(s, a, p):
        root = np.where(s.x > 0, np.sqrt(s.x), -s.x)
        inverse = np.where(s.v > 0.0, 1 / s.v, a.u)
        return {"x": root, "v": inverse + np.maximum(s.x, -np.inf)}

    made = system_of(model, kind="derivative", **SPACE)
    x = np.array([[-1.0, -2.0], [1.0, 6.0], [-0.02, 8.0], [-0.5, -3.0]])
    for eps in (0.0, 0.1):
        u, p = np.ones((4, 1)), np.ones(2)
        f_x, f_u = made.linearise(x[:3], u[:3], p, 1e-3, eps)
        if eps == 0.0:
            y = made.step(x[:, :], u, p, 1e-3, eps)
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

    x, u, p = np.zeros((1, 2)), np.ones((1, 1)), np.ones(2)
    made = system_of(drag, kind="derivative", integrator="euler", **SPACE)
    f_x, f_u, f_p = made.sensitivities(x, u, p, 0.1, eps)
    np.testing.assert_array_equal(f_x[0], np.eye(2))
    np.testing.assert_allclose(f_u[0], [[0.1], [0.0]])
    np.testing.assert_array_equal(f_p[0], 0.0)
    away = made.linearise(np.array([[3.0, 4.0]]), u, p, 0.1, eps)[0][0]
    assert away[0, 1] == pytest.approx(-0.1 * (3 * 0.8 + 0.8))


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


def ordinary(model, rng):
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


@pytest.mark.slow
@pytest.mark.parametrize("model", [car.model, pendulum.model, aircraft.model], ids=lambda m: m.name)
def test_derivatives_agree_with_central_differences(model):
    x, u = ordinary(model, np.random.default_rng(0))
    system, p, dt = model.system, model.values, 0.02
    assert system.how == "compiled" and system.note == ""
    found = system.sensitivities(x, u, p, dt)
    near = by_all(lambda *at: system.step(*at, dt), x, u, p, 1e-5)
    for exact, difference in zip(found, near, strict=True):
        scale = 1 + np.abs(exact).max(axis=(0, 2), keepdims=True)
        assert np.abs((exact - difference) / scale).max() < 1e-6


def endless(s, a, p):
    total = a.u
    for _ in range(30_000):
        total = np.sin(total) + a.u * s.x
    return {"x": total}


@pytest.mark.slow
def test_a_loop_that_unrolls_too_far_names_file_and_line():
    model = Model(states={"x": "m"}, inputs={"u": "1"}, derivative=endless)
    with pytest.raises(GroundedError, match=r"test_derivatives\.py:\d+: .*\bunrolls\b"):
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
    weights = {"effort": 1.0, "change": 1.0, "start": np.ones(12)}
    task = plain_task(model, 0.1, np.zeros((21, 12)), 1.0, 1.0, **weights)
    result = ddp.solve(task.problem(), np.zeros((20, 1)))
    assert np.isfinite(result.cost) and np.isfinite(result.K).all()


NAMES = {"states": {"x": "m", "v": "m/s"}, "inputs": {"u": "N"}, "params": {"c": Param(3.0)}}


def rate(s, a, p):
    return {"x": s.v, "v": a.u - p.c * np.sin(s.x) - 0.4 * s.v * np.abs(s.v)}


def opaque(s, a, p):
    """The same, but nothing that can be traced."""
    return {"x": s.v, "v": a.u - p.c * np.sin(s.x) - 0.4 * s.v * (s.v if s.v > 0 else -s.v)}


def samples(count=5):
    rng = np.random.default_rng(0)
    return rng.normal(size=(count, 2)), rng.normal(size=(count, 1))


@pytest.mark.parametrize("function", [rate, opaque])
@pytest.mark.parametrize("integrator", ["rk4", "euler"])
def test_substeps_are_steps_in_a_row(function, integrator):
    one = Model(**NAMES, derivative=function, integrator=integrator)
    four = Model(**NAMES, derivative=function, integrator=integrator, substeps=4)
    assert four.system.how == ("compiled" if function is rate else "differenced")
    x, u = samples()
    expected = x
    for _ in range(4):
        expected = one.system.step(expected, u, one.values, 0.05)
    found = four.system.step(x, u, four.values, 0.2)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13)


def test_the_derivatives_of_substeps_are_exact():
    model = Model(**NAMES, derivative=rate, substeps=3)
    x, u = samples()
    found = model.system.linearise(x, u, model.values, 0.2)
    near = by_all(lambda *at: model.system.step(*at, 0.2), x, u, model.values)
    for exact, difference in zip(found, near[:2], strict=True):
        np.testing.assert_allclose(exact, difference, atol=1e-8)


def step_of(s, a, p, dt):
    return {"x": s.x + dt * s.v, "v": s.v + dt * (a.u - p.c * s.x)}


def exact(s, a, p, dt):
    one = np.ones_like(np.asarray(s.x, float))
    f_x = np.stack([np.stack([one, dt * one], -1), np.stack([-p.c * dt * one, one], -1)], -2)
    return f_x, np.stack([0 * one, dt * one], -1)[..., None]


def sampled(s, a, p, dt):
    return np.array([[1.0, dt], [-float(p.c) * dt, 1.0]]), np.array([[0.0], [dt]])


@pytest.mark.parametrize("jacobian", [exact, sampled])
def test_derivatives_beside_a_step_are_used(jacobian):
    own = Model(**NAMES, step=step_of, jacobian=jacobian)
    found = Model(**NAMES, step=step_of)
    x, u = samples()
    for mine, theirs in zip(
        own.system.linearise(x, u, own.values, 0.1),
        found.system.linearise(x, u, found.values, 0.1),
        strict=True,
    ):
        np.testing.assert_allclose(mine, theirs, atol=1e-12)
    own.system.check(x, u, own.values, 0.1)
    f_p = own.system.sensitivities(x, u, own.values, 0.1)[2]
    np.testing.assert_allclose(f_p[:, 1, 0], -0.1 * x[:, 0], atol=1e-9)


def test_derivatives_of_another_step_are_found_out():
    def wrong(s, a, p, dt):
        f_x, f_u = exact(s, a, p, dt)
        return f_x, 2 * f_u

    model = Model(**NAMES, step=step_of, jacobian=wrong)
    x, u = samples()
    with pytest.raises(GroundedError, match=holding("'v'", "'u'")):
        model.system.check(x, u, model.values, 0.1)
    bad = Model(**NAMES, step=step_of, jacobian=lambda s, a, p, dt: (np.eye(3), np.eye(2)))
    with pytest.raises(GroundedError, match=holding("jacobian", "(2, 2)", "(2, 1)")):
        bad.system.linearise(x, u, bad.values, 0.1)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"derivative": rate, "substeps": 0}, "substeps .* 1 to 1000, not 0"),
        ({"step": step_of, "substeps": 2}, "derivative= and substeps="),
        ({"derivative": rate, "jacobian": exact}, "step= and jacobian="),
    ],
)
def test_what_does_not_go_together_is_said(fields, message):
    with pytest.raises(GroundedError, match=message):
        Model(**NAMES, **fields)


def test_an_adopted_effect_keeps_the_substeps():
    model = Model(**NAMES, derivative=rate, substeps=4)
    effect = Library().effect("viscous_friction:v", model)
    wrapped = wrap(effect, {q.name: 0.0 for q in effect.quantities}, 0.2)
    x, u = samples()
    np.testing.assert_allclose(
        wrapped.system.step(x, u, wrapped.values, 0.2),
        model.system.step(x, u, model.values, 0.2),
        rtol=1e-12,
        atol=1e-13,
    )


def test_a_function_that_takes_one_sample_at_a_time_says_so():
    model = Model(**NAMES, derivative=opaque)
    before = model.system.note
    assert before.startswith("not compiled") and "one sample" not in before
    x, u = samples()
    model.system.step(x, u, model.values, 0.1)
    model.system.step(x, u, model.values, 0.1)
    assert model.system.note.count("one sample at a time") == 1


def single(s, a, p, dt):
    """A step that computes in float32, as JAX and most simulators on a GPU do."""
    f = np.float32
    x, v, u = (np.asarray(value).astype(f) for value in (s.x, s.v, a.u))
    later = v + f(dt) * (u - f(3.0) * np.sin(x))
    return {"x": x + f(dt) * later, "v": later}


def test_single_precision_is_found_out_and_differenced_with_a_step_that_fits():
    """FACTS 7, reason 8: 0.1 stepped by 6e-6, where float32 has no digits left: 4 to 6 % off."""
    model = Model(**NAMES, step=single)
    x, u = samples()
    f_x, f_u = model.system.linearise(x, u, model.values, 0.02)
    slope = -0.02 * 3.0 * np.cos(x[:, 0])
    exact = np.array([[[1 + 0.02 * k, 0.02], [k, 1.0]] for k in slope])
    np.testing.assert_allclose(f_x, exact, atol=2e-4)
    np.testing.assert_allclose(f_u[:, :, 0], np.tile([0.0004, 0.02], (5, 1)), atol=2e-4)
    assert "float32" in model.system.note
    double = Model(**NAMES, derivative=opaque)
    double.system.linearise(x, u, double.values, 0.02)
    assert "float32" not in double.system.note


def test_differences_are_taken_inwards_at_the_limits_of_an_input():
    def clamped(s, a, p):
        return {"x": s.v, "v": (a.u if -1 < a.u < 1 else (1.0 if a.u > 0 else -1.0))}

    model = Model(**NAMES, derivative=clamped)
    u, limits = np.array([[-1.0], [0.0], [1.0], [1.0 - 1e-9]]), (-np.ones(1), np.ones(1))
    system, x = model.system, np.zeros((4, 2))
    assert system.how == "differenced"
    _, f_u = system.linearise(x, u, model.values, 0.1, 0.0, limits)
    np.testing.assert_allclose(f_u[:, 1, 0], 0.1, rtol=1e-6)
    beyond = system.linearise(x, u + 2.0, model.values, 0.1, 0.0, limits)[1]
    assert np.isfinite(beyond).all()
