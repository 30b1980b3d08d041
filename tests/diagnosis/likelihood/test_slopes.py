"""What data are used; slopes of steps and of the likelihood, also a simulator's; the climb."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.challenge.cases import make
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood import data as diagnosis_data
from grounded.diagnosis.likelihood import marching
from grounded.diagnosis.likelihood.carried import Carried, stepper
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.groups import folds
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.joint_memory import remembering
from grounded.diagnosis.likelihood.linearise import (
    gains_of,
    linearise,
    sensitivities,
    step_jacobian,
)
from grounded.diagnosis.likelihood.noise import Structure, likelihood_slopes, started
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.refine import refine
from grounded.diagnosis.likelihood.simulated import Slopes, simulated
from grounded.diagnosis.likelihood.step import bounded
from grounded.diagnosis.validation.limits import limits
from grounded.diagnosis.validation.ruler import Ruler
from grounded.effects import Library, wrap
from grounded.effects.plain_step import plain_step
from grounded.filter.kalman import innovations, smoother
from grounded.models.pendulum import model as pendulum
from small_tasks import DT, pushed_cart
from stepped import logged, slopes, stepped


@pytest.mark.parametrize("seed", [0, 1])
def test_a_bounded_step_is_the_best_one_inside(seed):
    """With the unknowns that stopped held where they are, nothing else wants to move."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((12, 4))
    G, slope = A.T @ A, 3 * rng.standard_normal(4)
    low, high = -rng.uniform(0, 0.2, 4), rng.uniform(0, 0.2, 4)
    low[3], high[3] = -np.inf, np.inf
    step = bounded(G, slope, low, high)
    assert (step >= low).all() and (step <= high).all()
    inside = (step > low) & (step < high)
    assert np.abs((G @ step + slope)[inside]).max(initial=0.0) < 1e-9
    np.testing.assert_allclose(
        bounded(G, slope, low - np.inf, high + np.inf), -np.linalg.solve(G, slope)
    )


@pytest.mark.parametrize("tau", [None, 0.1])
def test_the_slopes_of_the_noise_are_those_of_the_likelihood(tau):
    rng, trials = np.random.default_rng(2), []
    for _ in range(12):
        x = np.cumsum(0.1 * rng.standard_normal((13, 1)), axis=0)
        y = x + 0.1 * rng.standard_normal((13, 1))
        trials.append(Trial(y, np.zeros((12, 1)), 0.05, ("x",), ("u",)))
    drift = Model(
        states={"x": "m"}, inputs={"u": "m/s"}, params={}, derivative=lambda s, a, p: {"x": a.u}
    )
    data = prepare(drift, trials)
    predictor, h, track = Predictor(data), Hypothesis(), data.y.copy()
    start = HypothesisSearch(data, ()).fresh(h)[1].allowing(Structure(tau), data.dt)

    def likelihood(noise):
        return refine(predictor, [(h, noise, track)], iterations=1)[0].loglik

    F, d, r = linearise(predictor, h, track)
    g = gains_of(predictor, h, start, track, F)
    white = innovations(g, d, r)[0][..., 0]
    starts = started(g, white, start.structure.phi(data.dt))
    slope = likelihood_slopes(start, smoother(g, white), data.dt, starts)
    for row, name in zip(slope, ("log_q", "log_r", "log_c"), strict=False):
        up, down = (replace(start, **{name: getattr(start, name) + e}) for e in (1e-4, -1e-4))
        assert row[0] == pytest.approx((likelihood(up) - likelihood(down)) / 2e-4, rel=1e-3)


@pytest.fixture(scope="module")
def cars():
    case = next(iter(make("none", 1, 17, only="car")))
    return case, prepare(case.task.model, case.trials, case.task.latency)


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
    u = predictor.inputs(h)
    found = slopes(lambda x: predictor.advance(h, x, u, data.time), track[:-1])
    error = np.abs(step_jacobian(predictor, h, track) - found).max(axis=-2)
    most = np.abs(found).max(axis=(0, 1, 2))
    # kinks (braking, a limit that is just reached) lie on few of the steps
    assert (np.quantile(error, 0.9, axis=(0, 1)) < 0.02 * np.maximum(1.0, most)).all()


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
    model = case.task.model
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


STEPS = 60


def data_of(model):
    rng, trials = np.random.default_rng(1), []
    for _ in range(3):
        u = 0.3 * rng.standard_normal((STEPS, model.m))
        x = stepped(model, u, 0.05, 0.3 * np.ones(model.n))
        trials.append(logged(model, x, u, 0.05, 1e-3, rng))
    return prepare(model, trials)


def valued(effect, part):
    """Some value of each free quantity."""
    found = {}
    for q in effect.free:
        low, high = max(q.low, -0.2), min(q.high, 0.4)
        found[q.name] = float(np.quantile(q.grid, part)) if q.grid else low + part * (high - low)
    return found


def turned(model):
    """The model as a step that returns its states in another order."""
    step = plain_step(model)

    def backwards(s, a, p, dt):
        return dict(reversed(step(s, a, p, dt).items()))

    return replace(model, derivative=None, step=backwards)


@pytest.mark.slow
@pytest.mark.parametrize("before", ["", "delay", "first_order_lag"])
@pytest.mark.parametrize("model", [pendulum, turned(pendulum)], ids=["derivative", "step"])
def test_a_compiled_hypothesis_goes_where_its_steps_lead(model, before, monkeypatch):
    monkeypatch.setattr(marching, "STEPS_TO_COMPILE", 1)
    data = data_of(model)
    predictor, compiled, refused = Predictor(data), set(), set()
    by_family = {e.family.name: e for e in Library().candidates(model, data.scales)}
    for effect in by_family.values():
        h = Hypothesis().plus(effect, valued(effect, 0.5))
        if not (h.rates or h.losses):
            continue
        if remembering(h):  # what a joint remembers follows from motion, whatever else acts on it
            h = h.plus(by_family["viscous_friction"], {"k": 0.4})
        if before:  # inputs that change within a step
            late = by_family[before]
            h = h.plus(late, {late.quantities[0].name: 0.4 * data.dt})
        sent = predictor.received(h, leads=True)
        x, u = predictor.widened(h, data.y[:-1])[0], sent[:, : len(data.y)].transpose(1, 0, 2)
        path = [x]
        with np.errstate(all="ignore"):
            for k, now in enumerate(u):
                path.append(predictor.advance(h, path[-1], now, np.full(len(x), k * data.dt)))
            found = marching.marched(predictor, h, x, u)
        (refused if found is None else compiled).add(effect.family.name)
        if found is not None:
            np.testing.assert_allclose(found, path, 1e-9, 1e-12, err_msg=effect.name)
    assert len(compiled) > 3 and {"periodic", "elastic_joint", "dahl_friction"} <= compiled


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


def swung():
    rng, x = np.random.default_rng(0), np.cumsum(np.ones((61, 2)), axis=0) / 30
    x[:, 1] = np.sin(x[:, 0])
    sent = [np.full(60, float(k)) for k in range(2)]
    return prepare(MODEL, [logged(MODEL, x, u, 0.02, 0.01, rng) for u in sent])


def test_columns_by_slopes_are_those_of_steps(monkeypatch):
    data = swung()
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
    data = swung()
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


LONG = 450  # three runs of 150 steps


@pytest.fixture
def known(monkeypatch):
    """A predictor of four trials without noise, of whose 12 runs 7 are kept; its fit."""
    model, _ = pushed_cart(trials=1)
    found = []
    for k in range(4):
        u = np.sin((1 + 0.2 * (k % 2)) * np.arange(LONG) * DT)  # 0 and 2, 1 and 3 repeat
        u = u * np.linspace(1, 2, LONG)  # so that more happens later
        found.append(logged(model, stepped(model, u, DT), u, DT))
    monkeypatch.setattr(diagnosis_data, "MOST_NUMBERS", 7.5 * 150 * model.n**2 * 4)
    monkeypatch.setattr(diagnosis_data, "SESSION", 0)
    predictor = Predictor(prepare(model, found))
    assert predictor.data.time[0, :].tolist().count(0.0) == 3  # the beginnings of 0, 1 and 3
    assert len(predictor.data.valid) == 7
    return predictor, SimpleNamespace(hypothesis=Hypothesis(), states=predictor.data.y), found


def test_of_long_data_two_runs_of_one_candidate_are_kept_from_their_beginning(known):
    predictor, _, trials = known
    ran = [replace(t, candidate=c) for t, c in zip(trials, ["a", "b", "b", "c"], strict=True)]
    data = prepare(predictor.data.model, ran)
    begins = data.trial_of[data.time[0] == 0.0]
    assert {1, 2} <= {*begins.tolist()} and len(data.valid) == 7


def test_repeats_are_compared_at_the_same_time(known):
    predictor, fit, _ = known
    fit.hypothesis = Hypothesis(shift=np.array([0.5, 0.0]))  # wrong alike in repeats
    ruler = Ruler(predictor)
    np.testing.assert_allclose(ruler.scatter(fit, [[0, 2], [1, 3]])[0], 0.0, atol=1e-9)
    assert ruler.scatter(fit, [[1, 2]]) is None  # nothing that begins together


def test_short_repeats_say_nothing_of_longer_trials_and_little_of_long_horizons(known):
    predictor, _, trials = known
    short = [replace(t, states=t.states[:61], inputs=t.inputs[:60]) for t in trials[::2]]
    for some, whole in ((short, True), ([*short, trials[1]], False)):
        data = prepare(predictor.data.model, some)
        fit = SimpleNamespace(hypothesis=Hypothesis(), states=data.y)
        ruler = Ruler(Predictor(data))
        floor, unsure = ruler.scatter(fit, [[0, 1]])
        assert np.isfinite(floor[:-1]).all() and np.isfinite(floor[-1]).all() == whole
        assert unsure[0] < unsure[len(ruler.steps) - 1] < unsure[-1]


def test_of_long_data_the_runs_are_kept_in_which_most_happens(monkeypatch):
    model, _ = pushed_cart(trials=1)
    monkeypatch.setattr(diagnosis_data, "MOST_NUMBERS", 6.5 * 200 * model.n**2 * 4)
    busy = {3, 7, 11, 15, 19}  # of twenty runs of 200 steps, of four trials
    found = []
    for k in range(4):
        u = np.zeros((1000, 1))
        for run in range(5):
            if 5 * k + run in busy:
                u[200 * run : 200 * run + 200, 0] = np.sin(np.arange(200) * DT)
        x = np.vstack([np.zeros((1, 2)), np.cumsum(np.hstack([u, u]), axis=0)])
        found.append(Trial(x, u, DT, model.state_names, model.input_names))
    data = prepare(model, found)
    number = 5 * data.trial_of + np.rint(data.time[0] / (200 * DT)).astype(int)
    assert data.skipped == 14
    beginnings, busiest = {0, 5, 15}, {3, 11, 19}  # the busiest of each group of neighbours
    assert set(number.tolist()) == beginnings | busiest


CART = Model(
    states={"x": "m", "v": "m/s"},
    inputs={"u": "m/s^2"},
    params={"k": Param(1.0, "1", std=0.1)},
    roles={"position": ("x",), "speed": "v"},
    derivative=lambda s, a, p: {"x": s.v, "v": p.k * a.u - s.v},
)


def trial(omega=1.1, size=1.0, level=0.0, seed=0, steps=120, **more):
    """A cart under a sine or a level, with noise that makes no motion different."""
    u = level or size * np.sin(omega * np.arange(steps) * DT)
    x = stepped(CART, u + np.zeros(steps), DT)
    return logged(CART, x, u + np.zeros(steps), DT, 0.01, np.random.default_rng(seed), **more)


@pytest.mark.parametrize(
    ("trials", "groups"),
    [
        ([trial(), trial(seed=1), trial(2.7)], [(0, 1), (2,)]),
        ([trial(), trial(size=0.5), trial(seed=2)], [(0, 2), (1,)]),
        ([trial(level=0.2), trial(level=0.4), trial(level=0.2)], [(0, 2), (1,)]),
        ([trial(), trial(steps=60)], [(0,), (1,)]),
        ([trial(group="wet"), trial(seed=1, group="dry")], [(0,), (1,)]),
        ([trial(group="wet"), trial(2.7, group="wet"), trial(2.7)], [(0, 1), (2,)]),
        ([trial()], [(0,)]),
    ],
)
def test_trials_of_one_motion_in_one_condition_are_a_group(trials, groups):
    assert [group.trials for group in prepare(CART, trials).groups] == groups


@pytest.mark.parametrize(
    ("group", "steps", "levels", "expected"),
    [
        ([0, 1, 0, 1], [50, 50, 50, 50], True, [0, 1, 0, 1]),  # half of all, at its own level
        ([0, 1, 0, 1], [50, 50, 50, 50], False, [0, 1, 2, 3]),  # the rest would extrapolate
        ([0, 0, 0, 1], [50, 50, 50, 50], True, [1, 2, 3, 0]),  # most of all: trial by trial
        ([0, 1, 2], [10, 10, 80], False, [0, 1, 2]),
        ([0], [100], False, [0]),
    ],
)
def test_a_fold_is_a_group_or_part_of_one_that_holds_most(group, steps, levels, expected):
    own = np.full(len(group), levels)
    assert folds(np.array(group), np.arange(len(group)), steps, own).tolist() == expected
