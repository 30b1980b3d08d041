"""Effects that join a model with late sensors act on what moves, not on the log of it."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.linearise import step_jacobian
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects import Library, memory_of, wrap
from grounded.models.car import model as car
from grounded.trial import Trial

DT = 0.05
LATE = {
    "part of a step": [("sensor_delay:v", {"d": 0.02})],
    "two steps": [("sensor_delay:v", {"d": 0.12})],
    "filtered": [("sensor_lag:v", {"tau": 0.07})],
    "both": [("sensor_delay:v", {"d": 0.12}), ("sensor_lag:v", {"tau": 0.07})],
    "heading": [("sensor_delay:psi", {"d": 0.12})],
    "under a lag of an input": [
        ("sensor_delay:v", {"d": 0.12}),
        ("first_order_lag:throttle", {"tau": 0.1}),
    ],
}
MOVES = [
    ("coulomb_friction:v", {"c": 0.4}),
    ("rate_gain:v", {"g": 0.2}),
    ("offset:psi", {"c": 0.2}),
    ("viscous_friction:v", {"k": 0.3}),
    ("understeer:psi", {"k": 0.1}),
]


def built(parts, model=car):
    for name, values in parts:
        model = wrap(Library().effect(name, model), values, DT)
    return model


def late_data(model, base=car, steps=30):
    rng = np.random.default_rng(0)
    x, u = rng.uniform(0.2, 0.8, (steps + 1, base.n)), rng.uniform(-0.5, 0.5, (steps, base.m))
    one = Trial(x, u, DT, base.state_names, base.input_names)
    states = np.hstack([one.states, memory_of(model, base, one)])
    lifted = replace(one, states=states, state_names=model.state_names)
    return prepare(model, [lifted], hidden=model.state_names[base.n :])


def offered(name, data):
    (found,) = (e for e in Library().candidates(data.model, data.scales) if e.name == name)
    return found


@pytest.mark.parametrize(("name", "values"), MOVES, ids=lambda v: v if isinstance(v, str) else "")
@pytest.mark.parametrize("late", LATE.values(), ids=[*LATE])
def test_what_moves_a_model_with_late_logs_steps_as_the_model_that_adopts_it(late, name, values):
    model = built(late)
    data = late_data(model)
    effect, predictor = offered(name, data), Predictor(data)
    h = Hypothesis().plus(effect, effect.complete(values))
    x = np.random.default_rng(1).uniform(0.1, 1.0, (40, model.n))
    u = predictor.inputs(h)[:1, 0].repeat(40, axis=0)
    found = predictor.advance(h, x, u, np.zeros(40))
    within = built([(name, effect.complete(values)), *late])
    after = built([*late, (name, effect.complete(values))])
    for both in (within, after):
        order = [model.state_names.index(n) for n in both.state_names]
        want = both.system.step(x[:, order], u, both.values, DT)
        # a carried heading rate's own derivative is a difference here, exact there
        kept = [i for i, n in enumerate(both.state_names) if n != "psi_rate"]
        np.testing.assert_allclose(found[:, order][:, kept], want[:, kept], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "values"), MOVES[:3], ids=lambda v: v if isinstance(v, str) else ""
)
@pytest.mark.parametrize("late", [LATE["both"], LATE["part of a step"]], ids=["both", "part"])
def test_its_slopes_are_those_of_its_steps(late, name, values):
    data = late_data(built(late))
    effect, predictor = offered(name, data), Predictor(data)
    h, size = Hypothesis().plus(effect, effect.complete(values)), 1e-6
    x, u = data.y[:-1], predictor.inputs(h)
    F = step_jacobian(predictor, h, data.y)
    for j in range(data.model.n):
        nudge = size * np.eye(data.model.n)[j]
        ends = [predictor.advance(h, x + s * nudge, u, data.time) for s in (1, -1)]
        error = np.abs(F[..., j] - (ends[0] - ends[1]) / (2 * size))
        assert np.quantile(error.max(axis=-1), 0.9) < 0.02
