"""Several rate effects adopted together are the ones that were diagnosed together."""

import numpy as np
import pytest
from test_effects_order import DT, HELD, STEPS, commands, task

from grounded import Trial
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects import Library
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
    (TREND, UNDERSTEER),
]
BOTH_ORDERS = PAIRS[::2] + [(b, a) for a, b in PAIRS[1::2]]


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
