"""Stiff models in smaller steps, and derivatives that a model brings along."""

import numpy as np
import pytest

from facts import holding
from grounded.effects import Library, wrap
from grounded.errors import GroundedError
from grounded.model import Model, Param

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
    f_x, f_u = model.system.linearise(x, u, model.values, 0.2)
    h = 1e-6
    for i in range(2):
        up, down = x.copy(), x.copy()
        up[:, i] += h
        down[:, i] -= h
        step = model.system.step
        change = (step(up, u, model.values, 0.2) - step(down, u, model.values, 0.2)) / (2 * h)
        np.testing.assert_allclose(f_x[:, :, i], change, atol=1e-8)
    step = model.system.step
    change = (step(x, u + h, model.values, 0.2) - step(x, u - h, model.values, 0.2)) / (2 * h)
    np.testing.assert_allclose(f_u[:, :, 0], change, atol=1e-8)


def step_of(s, a, p, dt):
    return {"x": s.x + dt * s.v, "v": s.v + dt * (a.u - p.c * s.x)}


def exact(s, a, p, dt):
    one = np.ones_like(np.asarray(s.x, float))
    f_x = np.stack([np.stack([one, dt * one], -1), np.stack([-p.c * dt * one, one], -1)], -2)
    return f_x, np.stack([0 * one, dt * one], -1)[..., None]


def single(s, a, p, dt):
    return np.array([[1.0, dt], [-float(p.c) * dt, 1.0]]), np.array([[0.0], [dt]])


@pytest.mark.parametrize("jacobian", [exact, single])
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
