"""Frictions and springs with a memory: named where they are, and not where they are not.

The robots are integrated by RK4 at a twentieth of the control step, from the equations of motion of
both inertias, or of the bristle.
"""

import numpy as np
import pytest

from grounded import Model, Param, Trial, diagnose
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.validation.limits import knowable
from grounded.effects import Library, memory_of, wrap
from stepped import logged, stepped

DT, J, B = 0.01, 0.02, 0.02
JOINT = Model(
    states={"q": "rad", "w": "rad/s"},
    inputs={"tau": "N m"},
    params={"J": Param(J, "kg m^2", 0.01, 0.04), "b": Param(B, "N m s/rad", 0.0, 0.1)},
    derivative=lambda s, a, p: {"q": s.w, "w": (a.tau - p.b * s.w) / p.J},
)
DAHL, ELASTIC, LOAD = (
    f"{family}:tau<-w" for family in ("dahl_friction", "elastic_joint", "elastic_load")
)


def bristle(x, u, c=0.15, way=0.02):
    _, w, y = x
    return np.array([w, (u - B * w - c * y) / J, (w - abs(w) * y) / way])


def spring(x, u, part, stiff, driven, damping=0.02):
    """q, w of the side that is shown, and twist z with its rate; `part` of J is hidden."""
    _, w, z, r = x
    hidden, pull = part * J, stiff * z + damping * r
    rate = (u - B * w - (driven * u - pull)) / (J - hidden)
    return np.array([w, rate, r, (driven * u - pull) / hidden - rate])


def dry(x, u, c=0.1):
    return np.array([x[1], (u - B * x[1] - c * np.tanh(x[1] / 0.005)) / J])


def late(x, u, lag=0.03):
    return np.array([x[1], (x[2] - B * x[1]) / J, (u - x[2]) / lag])


def wound(x, u):
    return np.array([x[1], (u - B * x[1] - 0.5 * x[0]) / J])


def motor_behind(x, u):
    return spring(x, u, 0.5, 13.0, 1.0)


def load_behind(x, u):
    return spring(x, u, 0.4, 8.0, 0.0)


def logs(rates, count, seed, steps=250):
    """Runs under multisines, with process noise and sensor noise."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(4):
        t = DT * np.arange(steps)
        waves = zip((0.25, 0.2, 0.15), rng.uniform(0.5, 6, 3), rng.uniform(0, 6, 3), strict=True)
        u = sum(a * np.sin(2 * np.pi * f * t + at) for a, f, at in waves)
        disturbed = 1e-3 * np.eye(count)[1]
        x = stepped(
            lambda x, u: rates(x, u[0]), u, DT, np.zeros(count), disturbed=disturbed, rng=rng
        )
        found.append(logged(JOINT, x[:, :2], u, DT, [2e-4, 5e-3], rng))
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rates", "count", "name", "known"),
    [
        (bristle, 3, DAHL, {"c": 0.15, "x": 0.02}),
        (motor_behind, 4, ELASTIC, {"f": np.sqrt(13.0 * J / (0.01 * 0.01)) / (2 * np.pi)}),
        (load_behind, 4, LOAD, {"J": 0.4 * J, "f": np.sqrt(8.0 / (0.4 * J)) / (2 * np.pi)}),
    ],
    ids=["dahl", "motor", "load"],
)
def test_a_withheld_memory_is_named_first_with_its_values(rates, count, name, known):
    found = diagnose(JOINT, logs(rates, count, 0))
    first = found.ranking[0]
    assert first.effect == name and first.claimed and found.effects == (name,)
    for quantity, value in known.items():
        assert first.values[quantity] == pytest.approx(value, rel=0.02)
    ahead = next(row for row in found.prediction_error if row.horizon_s == 0.5)
    assert ahead.with_effects["w"] < 0.2 * ahead.crude["w"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rates", "count"), [(dry, 2), (late, 3), (wound, 2)], ids=["dry", "lag", "spring"]
)
def test_none_is_named_where_there_is_none(rates, count):
    found = diagnose(JOINT, logs(rates, count, 0))
    assert found.effects and not {DAHL, ELASTIC, LOAD} & {*found.effects}


def test_a_friction_that_builds_up_is_offered_only_where_the_motion_reverses():
    turning, (one, *_) = logs(dry, 2, 0), logs(dry, 2, 1)
    ahead = Trial(np.abs(one.states), np.abs(one.inputs), DT, ("q", "w"), ("tau",))
    for trials, shown in ((turning, True), ([ahead], False)):
        data = prepare(JOINT, trials)
        offered = knowable(data, Library().candidates(JOINT, data.scales))
        assert (DAHL in {effect.name for effect in offered}) is shown


@pytest.mark.parametrize(
    ("name", "rates", "count"),
    [(DAHL, bristle, 3), (ELASTIC, motor_behind, 4), (LOAD, load_behind, 4)],
)
def test_an_adopted_memory_is_the_one_that_was_diagnosed(name, rates, count):
    (trial, *_) = logs(rates, count, 0, steps=100)
    predictor = Predictor(prepare(JOINT, [trial]))
    effect = Library().effect(name, JOINT, predictor.data.scales)
    values = {"c": 0.15, "x": 0.02, "J": 0.4 * J, "f": 5.03, "zeta": 0.04}
    values |= {"J": 0.5 * J, "f": 8.115, "zeta": 0.028} if name == ELASTIC else {}
    values = {q.name: values[q.name] for q in effect.free}
    adopted = wrap(effect, values, DT)
    assert adopted.system.how == "compiled"
    h, x = Hypothesis().plus(effect, values), trial.states[:-1, None]
    z = predictor.widened(h, x)[:, 0]
    want = predictor.advance(h, x, predictor.inputs(h), predictor.data.time)[:, 0]
    got = adopted.system.step(z, trial.inputs, adopted.values, DT)
    np.testing.assert_allclose(got[:, :2], want, atol=1e-9)
    # along the log the adopted model's memory goes the same way
    along = memory_of(adopted, JOINT, trial)
    assert np.abs(along[1:-1] - z[1:, 2:]).max() < 0.1 * np.abs(along).max()
    np.testing.assert_array_equal(along[0], 0.0)


@pytest.mark.parametrize(
    ("name", "rates", "values"),
    [
        (DAHL, bristle, {"c": 0.15, "x": 0.02}),
        (ELASTIC, motor_behind, {"J": 0.5 * J, "f": np.sqrt(13.0 / (0.25 * J)) / (2 * np.pi)}),
        (LOAD, load_behind, {"J": 0.4 * J, "f": np.sqrt(8.0 / (0.4 * J)) / (2 * np.pi)}),
    ],
)
def test_a_memory_moves_as_the_equations_of_motion_say(name, rates, values):
    effect = Library().effect(name, JOINT)
    stiff = values.get("f", 1.0) * 2 * np.pi * np.sqrt(0.5 if name == ELASTIC else 1.0)
    zeta = 0.02 / (2 * stiff * values.get("J", 1.0))
    model = wrap(effect, values | ({} if name == DAHL else {"zeta": zeta}), DT)
    t = DT * np.arange(200)
    u = 0.4 * np.sin(7 * t) + 0.3 * np.sin(23 * t)
    x = stepped(model, u, DT)[-1]
    z = stepped(lambda x, u: rates(x, u[0]), u, DT, np.zeros(model.n), fine=50)[-1]
    np.testing.assert_allclose(x[:2], z[:2], atol=0.01 * np.abs(z[:2]).max())
