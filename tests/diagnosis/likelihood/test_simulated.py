"""A simulator as the crude model: what it was asked is used again, where it is the same or near."""

import math

import numpy as np

from grounded.diagnosis.likelihood.carried import Carried, stepper
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.linearise import linearise
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.simulated import Slopes, simulated
from grounded.diagnosis.validation.limits import limits
from grounded.effects import Library
from grounded.model import Model, Param
from stepped import logged


def swinging(s, a, p, dt):
    """A pendulum that no tracer reads: it looks at a sample before it steps."""
    push = a["torque"] if s["theta"] < 1e3 else 0.0
    rate = push - p["g"] * math.sin(s["theta"]) - 0.1 * s["omega"]
    return {"theta": s["theta"] + dt * s["omega"], "omega": s["omega"] + dt * rate}


MODEL = Model(
    states={"theta": "rad", "omega": "rad/s"},
    inputs={"torque": "N m"},
    params={"g": Param(9.0, "1/s^2", 5.0, 15.0)},
    step=swinging,
)


def data_of():
    rng, x = np.random.default_rng(0), np.cumsum(np.ones((61, 2)), axis=0) / 30
    x[:, 1] = np.sin(x[:, 0])
    sent = [np.full(60, float(k)) for k in range(2)]
    return prepare(MODEL, [logged(MODEL, x, u, 0.02, 0.01, rng) for u in sent])


def test_columns_by_slopes_are_those_of_steps(monkeypatch):
    data = data_of()
    assert simulated(data.model)
    h = Hypothesis()
    for name, values in (("input_gain:torque", {"g": 0.1}), ("coulomb_friction:omega", {"c": 0.2})):
        h = h.plus(Library().effect(name, MODEL, data.scales), values)
    F, d, _ = linearise(Predictor(data), h, data.y)
    monkeypatch.setattr("grounded.diagnosis.likelihood.linearise.tangent", lambda p, *more: p)
    exact_F, exact, _ = linearise(Predictor(data), h, data.y)
    assert (exact_F == F).all() and (d[..., 0] == exact[..., 0]).all()
    size = np.abs(exact[..., 1:]).max(axis=(0, 1, 2))
    assert (size > 0).all() and (np.abs(d - exact)[..., 1:].max(axis=(0, 1, 2)) < 0.02 * size).all()


def test_steps_with_losses_take_one_call_of_the_simulator(monkeypatch):
    data = data_of()
    effect = Library().effect("joint_friction:torque<-omega", MODEL, data.scales)
    h = Hypothesis().plus(effect, {"c": 0.05, "b": 0.3})
    predictor = Predictor(data)
    x = np.array([[0.3, 1.0], [0.1, -0.2], [2.0, 0.0]])
    u = 0.5 * np.sin(np.arange(100) / 15)[:, None, None] * np.ones((100, 3, 1))
    asked, step = [], type(MODEL.system).step

    def counted(self, x, *more):
        asked.append(len(x))
        return step(self, x, *more)

    exact = [x]
    for now in u:
        exact.append(predictor.advance(h, exact[-1], now, np.zeros(3)))
    monkeypatch.setattr(type(MODEL.system), "step", counted)
    advance, carried = stepper(predictor, h), [x]
    for now in u:
        carried.append(advance(carried[-1], now, np.zeros(3)))
    plain = predictor.moved(Hypothesis(), x, u[30])
    assert np.abs(plain - predictor.moved(h, x, u[30])).max() > 1e-3  # the losses are felt
    np.testing.assert_allclose(np.stack(carried), np.stack(exact), atol=1e-5)
    assert sum(asked) < 1.5 * 300 < 3 * 300  # before, three of each row and step
    stays = Carried(data)
    assert (stays.moved(h, x, u[0], 1e-4) == predictor.moved(h, x, u[0], 1e-4)).all()


def test_hypotheses_set_out_from_the_slopes_of_the_first():
    asked = []

    def take(x, u):
        asked.append(len(x))
        return np.ones((len(x), 2, 2)), np.ones((len(x), 2, 1))

    first = Slopes((np.ones(2), np.ones(1), np.ones(1))).following()
    x, u, p = np.zeros((5, 2)), np.ones((5, 1)), np.ones(1)
    assert first.about(x) is None
    first.at(take, x, u, p, False)
    one, other = first.following(), first.following()
    moved = x + np.array([[0.0], [0.0], [1.0], [0.0], [1.0]])
    one.at(take, moved, u, p, False)
    assert asked == [5, 2] and other.about(x) == first.about(x)
    other.at(take, moved, u, p, False)  # the same rows were asked before
    assert asked == [5, 2] and other.about(x[:2]) is None


def test_of_a_long_log_the_stretches_that_move_most_are_asked():
    T = 3000
    x, u = np.zeros((T + 1, 2)), np.zeros((T, 1))
    u[2000:2400, 0] = np.sin(np.arange(400) / 5)
    x[2000:2401, 0] = np.cos(np.arange(401) / 50)
    data = prepare(MODEL, [logged(MODEL, x, u, 0.02)])
    assert data.steps <= 1000 < T and data.skipped == 15 and len(data.valid) == 5
    begin = data.step_at[:, 0]
    assert begin[0] == 0 and ((begin >= 1800) & (begin < 2400)).any()  # where the trial begins, too
    (one,) = [one for one in limits(data).findings if one.code == "model.share"]
    assert (one.facts["used"], one.facts["total"]) == (5, 20)
    short = prepare(MODEL, [logged(MODEL, x[:201], u[:200], 0.02) for _ in range(2)])
    assert short.skipped == 0 and short.steps == 400
