"""The filter's Jacobian is that of the whole hypothesis; thresholds have a slope; a mere offset."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.challenge.cases import make
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.linearise import linearise, sensitivities, step_jacobian
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects import Library, wrap


@pytest.fixture(scope="module")
def cars():
    case = next(iter(make("none", 1, 17, only="car")))
    return case, prepare(case.model, case.trials, case.latency)


def effect(data, name):
    return Library().effect(name, data.model, data.scales)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("coupling:psi<-v", {"k": 0.36}),
        ("viscous_friction:v", {"k": 0.8}),
        ("quadratic_drag:v", {"k": 0.5}),
        ("understeer:psi", {"k": 0.2}),
        ("rate_gain:v", {"g": 0.3}),
        ("slope:v", {"a": 0.2, "b": -0.3}),
        ("slew_limit:delta", {"r": 0.5}),
        ("grip_limit:psi", {"a": 1.0}),
    ],
)
def test_the_jacobian_is_that_of_the_hypothesis(cars, name, values):
    _, data = cars
    predictor, h = Predictor(data), Hypothesis().plus(effect(data, name), values)
    track = data.y.copy()
    track[..., data.model.state_names.index("v")] += 0.5  # away from the kink at rest
    F = step_jacobian(predictor, h, track)
    x, u, size = track[:-1], predictor.inputs(h), 1e-6
    for j in range(data.model.n):
        ends = []
        for sign in (-1, 1):
            moved = x.copy()
            moved[..., j] += sign * size
            ends.append(predictor.advance(h, moved, u, data.time))
        slope = (ends[1] - ends[0]) / (2 * size)
        error = np.abs(F[..., j] - slope)
        # kinks (braking, a limit that is just reached) lie on few of the steps
        assert np.quantile(error.max(axis=-1), 0.9) < 0.02 * max(1.0, np.abs(slope).max())


@pytest.mark.parametrize(
    ("name", "values"), [("viscous_friction:v", {"k": 2.0}), ("rate_gain:v", {"g": 0.3})]
)
def test_parameters_act_through_the_effects(cars, name, values):
    _, data = cars
    predictor = Predictor(data)
    h = replace(Hypothesis().plus(effect(data, name), values), spread=1.0)
    x, u, t = data.y[:-1], predictor.inputs(h), data.time
    d, size = linearise(predictor, h, data.y, whole=True)[1], 1e-6
    free = [p for p in data.model.params.values() if p.spread > 0]
    assert d.shape[-1] == 1 + len(values) + len(free)
    for i, param in enumerate(data.model.params.values()):
        shift = size * param.spread * np.eye(len(data.model.params))[i]
        up, down = (predictor.advance(replace(h, shift=s), x, u, t) for s in (shift, -shift))
        slope = data.model.difference(up, down) / (2 * size)
        got = d[..., 1 + len(values) + i]
        error = np.quantile(np.abs(got - slope).max(axis=-1), 0.9)
        assert error <= 1e-3 * np.abs(slope).max()


@pytest.mark.slow
def test_a_carried_heading_rate_is_limited_with_the_heading(cars):
    """A gyro shows what the tyres let the heading do; adopted, the model says the same."""
    _, data = cars
    predictor, grip = Predictor(data), effect(data, "grip_limit:psi")
    h, names = Hypothesis().plus(grip, {"a": 1.0}), data.model.state_names
    speed, rate = names.index("v"), names.index("psi_rate")
    x, u = data.y[:-1].copy(), predictor.inputs(h)

    def limited(at):
        own = predictor.instant(Hypothesis(), at, u)[..., names.index("psi")]
        most = 1.0 / np.maximum(np.abs(at[..., speed]), 1e-3)
        return np.clip(own, -most, most), np.abs(own) > 1.2 * most

    x[..., rate] = limited(x)[0]
    after = predictor.advance(h, x, u, data.time)
    expected, sliding = limited(after)
    assert sliding.mean() > 0.05
    np.testing.assert_allclose(after[..., rate], expected, atol=1e-9)
    model = wrap(grip, {"a": 1.0}, data.dt)
    adopted = model.system.step(*predictor.flat(x, u), model.values, data.dt).reshape(x.shape)
    np.testing.assert_allclose(adopted, after, atol=1e-4)


def test_a_threshold_of_the_model_has_a_slope(cars):
    case, data = cars
    model = case.model
    x = np.tile([0.0, 0.1, 0.0, 0.0, 0.0, 0.0], (9, 1))
    u = np.column_stack([np.zeros(9), np.linspace(0.16, 0.2, 9)])  # around the stall
    _, _, f_p = sensitivities(model, x, u, model.values, data.dt)
    exact = model.system.sensitivities(x, u, model.values, data.dt)[2]
    stall = model.param_names.index("stall")
    assert not exact[..., stall].any()
    assert f_p[:, model.state_names.index("v"), stall].min() < 0
    others = [i for i in range(len(model.param_names)) if i != stall and exact[..., i].any()]
    np.testing.assert_array_equal(f_p[..., others], exact[..., others])
    drag = Hypothesis().plus(effect(data, "viscous_friction:v"), {"k": 0.1})
    near = replace(data, commands=np.full_like(data.commands, 0.182))
    track = np.tile(x[0], (*data.y.shape[:2], 1))
    d = linearise(Predictor(near), replace(drag, spread=1.0), track, whole=True)[1]
    assert d[..., 2 + stall].any()  # also beside effects
