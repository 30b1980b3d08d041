"""Several rate effects adopted together are the ones that were diagnosed together."""

import math

import numpy as np
import pytest
from test_effects_order import DT, HELD, STEPS, commands, task

from grounded import Model, Trial
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects import Library, memory_start, wrap
from grounded.effects.plain_step import plain_step
from grounded.models.car import model as car
from grounded_trials.workspace.adopted import planner_of

FRICTION = ("viscous_friction:v", {"k": 0.8})
GAIN = ("rate_gain:v", {"g": 0.2})
PULL = ("offset:delta", {"c": 0.3})
TURN = ("offset:psi", {"c": 0.3})
UNDERSTEER = ("understeer:psi", {"k": 0.2})
COUPLING = ("coupling:psi<-v", {"k": 0.3})
SLIP = ("side_slip:x+y", {"k": 0.3})
SLEW = ("slew_limit:delta", {"r": 2.0})
TREND = ("trend:v", {"k": 0.1})
PAIRS = [
    (FRICTION, GAIN),
    (FRICTION, PULL),
    (TURN, UNDERSTEER),
    (COUPLING, SLIP),
    (GAIN, SLIP),
    (SLEW, FRICTION),
    (SLEW, GAIN),
    (SLEW, ("slew_limit:v", {"r": 0.5})),
    (TREND, UNDERSTEER),
]
BOTH_ORDERS = PAIRS + [(b, a) for a, b in PAIRS]


def names(parts):
    return " ".join(name for name, _ in parts)


def trial():
    """The bare car, driven, with commands held before."""
    x = [np.array([0.1, 1.0, 0.0, 0.0, 0.0, np.sin(0.1) / 0.15])]
    for u in commands():
        x.append(car.system.step(x[-1][None], u[None], car.values, DT)[0])
    return Trial(np.array(x), commands(), DT, car.state_names, car.input_names, start_inputs=HELD)


def adopted(parts):
    return planner_of(task(), [{"name": name, **values} for name, values in parts]).plan.model


def drive(model, one):
    """States of a wrapped model from the trial's start with its commands, (STEPS + 1, n)."""
    z = [np.hstack([one.states[0], memory_start(model, car, one)])]
    for u in one.inputs:
        z.append(model.system.step(z[-1][None], u[None], model.values, DT)[0])
    return np.array(z)[:, : car.n]


@pytest.mark.slow
@pytest.mark.parametrize("parts", BOTH_ORDERS, ids=names)
def test_a_pair_steps_as_it_was_diagnosed(parts):
    one = trial()
    predictor = Predictor(prepare(car, [one]))
    h = Hypothesis()
    for name, values in parts:
        h = h.plus(Library().effect(name, car, predictor.data.scales), values)
    x, t = one.states[:-1], np.arange(STEPS) * DT
    want = predictor.advance(h, x, one.inputs, t)
    effect = np.abs(want - predictor.advance(Hypothesis(), x, one.inputs, t)).max(axis=0)
    model = adopted(parts)
    clocks = np.repeat(t[:, None], model.n - car.n, axis=1)
    got = model.system.step(np.hstack([x, clocks]), one.inputs, model.values, DT)[:, : car.n]
    assert (np.abs(got - want).max(axis=0) <= 0.05 * effect + 1e-9).all()
    assert not model.system.note  # it is compiled


@pytest.mark.parametrize("parts", BOTH_ORDERS, ids=names)
def test_the_carried_heading_rate_stays_the_headings(parts):
    one = trial()
    x = drive(adopted(parts), one)
    model = adopted([part for part in parts if ":psi" in part[0]])  # no other turns it
    h = 1e-5
    start = np.hstack([x, np.zeros((len(x), model.n - car.n))])
    u = np.zeros((len(x), 2))  # the heading's rate depends on no command
    ahead = model.system.step(start, u, model.values, h)
    rate = (ahead[:, 4] - x[:, 4]) / h
    drift = (x[:, 5] - rate) - (x[0, 5] - rate[0])
    assert np.abs(drift[[20, 60]]).max() < 0.01


@pytest.mark.slow
def test_pairs_wrapped_in_any_order_are_one_model():
    one, models = trial(), []
    for parts in ((SLEW, FRICTION, GAIN), (GAIN, SLEW, FRICTION)):
        model = car
        for name, values in parts:
            model = wrap(Library().effect(name, model), values, DT)
        models.append(model)
    first, second = (drive(model, one) for model in models)
    np.testing.assert_allclose(first, second, atol=1e-12)


@pytest.mark.parametrize(
    "name, values, uncertain",
    [
        ("input_curve:throttle", {"a": 0.0, "b": -0.13, "U": 1.0}, {"b"}),
        ("input_curve:throttle", {"a": 0.2, "b": -0.13, "U": 1.0}, {"a", "b"}),
        ("input_gain:throttle", {"g": 0.0}, {"g"}),
        ("coulomb_friction:v", {"c": 0.0}, {"c"}),
    ],
)
def test_the_side_of_an_input_that_was_never_seen_stays_unknown(name, values, uncertain):
    model = wrap(Library().effect(name, car), values, DT)
    stem = name.replace(":", "_") + "_"
    free = {n.removeprefix(stem) for n, p in model.params.items() if p.uncertain}
    assert free & set(values) == uncertain


def test_a_heading_rate_carried_by_the_users_own_step_follows_too():
    rk4 = plain_step(car)
    own = Model(
        states=car.states,
        inputs=car.inputs,
        params=car.params,
        angles=car.angles,
        roles=car.roles,
        step=lambda s, a, p, dt: rk4(s, a, p, dt),
    )
    x = drive(wrap(Library().effect(FRICTION[0], own), FRICTION[1], DT), trial())
    np.testing.assert_allclose(x[:, 5], x[:, 1] * np.sin(x[:, 0]) / 0.15, atol=2e-3)


def test_pythons_own_math_is_compiled_through_two_effects():
    swing = Model(
        states={"angle": "rad", "rate": "rad/s"},
        inputs={"torque": "1"},
        derivative=lambda s, a, p: {
            "angle": s.rate,
            "rate": max(a.torque, 0.0) - math.sin(s.angle),
        },
    )
    model = swing
    for name, values in (("offset:rate", {"c": 0.1}), ("input_gain:torque", {"g": 0.1})):
        model = wrap(Library().effect(name, model), values, DT)
    assert not model.system.note
