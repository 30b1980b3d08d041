"""The scan and its maxima; changes of a set of effects: other inputs, another order, plainer."""

from dataclasses import replace

import numpy as np
import pytest

from grounded import Model, Param
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.hypotheses import scan
from grounded.diagnosis.hypotheses.scan import elsewhere
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.hypotheses.variations import variations, varied
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.effects import Library
from grounded.models.car import model as car
from grounded.models.pendulum import model as pendulum
from stepped import levels, library, logged, stepped

DT, FADE, RATE = 0.02, 0.03, 5.0
VALVES = Model(
    name="valves",
    states={"v": "m/s", "w": "m/s"},
    inputs={"a": "1", "b": "1"},
    params={"tau": Param(0.15, "s")},
    derivative=lambda s, a, p: {"v": (a.a - s.v) / p.tau, "w": (a.b - s.w) / p.tau},
)
LIMIT, WEAKER, DELAY = "rate_limit:a", "input_fade:a", "delay:a"


def valves(trials=3, steps=300):
    """Valves whose first spool is slow and whose oil then flows ever less: limit, then fade."""

    def rates(x, u):
        spool = np.clip(50.0 * (u[0] - x[2]) / DT, -RATE, RATE)
        acting = np.array([(1 - FADE * x[3]) * x[2], u[1]])
        return np.r_[(acting - x[:2]) / 0.15, spool, 1.0]

    rng, found, t = np.random.default_rng(3), [], DT * np.arange(steps)
    for k in range(trials):
        u = np.stack([np.sign(np.sin((2.1 + 0.4 * k) * t)), np.sin((1.3 + 0.3 * k) * t)], axis=1)
        disturbed = np.array([1e-3, 1e-3, 0, 0])
        x = stepped(rates, u, DT, np.zeros(4), fine=40, disturbed=disturbed, rng=rng)
        found.append(logged(VALVES, x[:, :2], u, DT, 2e-3, rng))
    return found


@pytest.fixture(scope="module")
def search():
    data = prepare(VALVES, valves())
    found = HypothesisSearch(data, Library().candidates(VALVES, data.scales))
    found.refined([found.fresh(Hypothesis())])
    return found


def hypothesis(search, *parts):
    known, h = {effect.name: effect for effect in search.candidates}, Hypothesis()
    for name, values in parts:
        h = h.plus(known[name], values)
    return h


def test_an_effect_that_is_found_later_may_act_first(search):
    fade = hypothesis(search, (WEAKER, {"k": FADE}))
    few = HypothesisSearch(search.data, [e for e in search.candidates if e.name == LIMIT])
    (fit,) = few.refined([few.fresh(fade)], 25)
    few.refined(few.extended(fit), 25)
    (best,) = few.of_size(2)
    assert best.hypothesis.names == (LIMIT, WEAKER)
    assert best.hypothesis.values[0]["r"] == pytest.approx(RATE, rel=0.02)
    assert best.hypothesis.values[1]["k"] == pytest.approx(FADE, rel=0.05)


def names_of(search, *parts):
    """Return the effects of all variations of a set, each in its order."""
    return [h.names for h in variations(search, hypothesis(search, *parts))]


def test_a_set_is_rivalled_by_those_that_blame_fewer_inputs(search):
    both, fade = ("rate_limit:a+b", {"r": RATE}), (WEAKER, {"k": FADE})
    (fit,) = search.refined([search.fresh(hypothesis(search, both, fade))], 25)
    varied(search, fit)
    found = {f.hypothesis.names: search.score(f) for f in search.of_size(2)}
    assert found[LIMIT, WEAKER] > search.score(fit) - 1  # only one of the valves is slow
    assert found["rate_limit:b", WEAKER] < search.score(fit) - 10


@pytest.mark.parametrize("more", [("first_order_lag:b", "tau"), ("delay:b", "d")])
def test_a_delay_of_each_input_replaces_one_of_all_and_more_of_some(search, more):
    later, name = more
    both, limit = ("delay:a+b", {"d": 0.04}), (LIMIT, {"r": RATE})
    found = names_of(search, both, (later, {name: 0.01}), limit)
    assert (DELAY, "delay:b", LIMIT) in found
    assert (DELAY, "delay:b") in names_of(search, both)


def test_a_command_that_is_later_than_another_gets_a_delay_of_its_own(fine=10, count=400):
    robot = Model(
        states={"v": "m/s", "w": "rad/s"},
        inputs={"throttle": "1", "steer": "rad"},
        derivative=lambda s, a, p: {"v": 3 * (a.throttle - s.v), "w": 4 * (a.steer - s.w)},
    )
    rng, late = np.random.default_rng(1), {"delay:throttle": 0.03, "delay:steer": 0.05}
    sent = levels(rng, count // 8, 8, m=2)
    parts = np.repeat(sent, fine, axis=0)
    for j, d in enumerate(late.values()):
        parts[:, j] = np.r_[np.zeros(round(d / DT * fine)), parts[:, j]][: len(parts)]
    x = stepped(robot, parts, DT / fine)[::fine]
    data = prepare(robot, [logged(robot, x, sent, DT, 2e-3, rng)])
    offered = Library().candidates(robot, data.scales)
    search = HypothesisSearch(data, [e for e in offered if e.family.name == "delay"])
    with np.errstate(all="ignore"):
        both = Library().effect("delay:throttle+steer", robot, data.scales)
        start = search.fresh(search.fresh(Hypothesis())[0].plus(both, {"d": 0.03}))
        (fit,) = search.refined([start], 12)
        search.refined([search.fresh(Hypothesis())], 1)
        varied(search, fit)
    found = max(search.fits.values(), key=search.score)
    assert {e.name: v["d"] for e, v in found.hypothesis.pairs} == pytest.approx(late, abs=2e-3)


MOTOR = Model(
    name="motor",
    states={"q": "rad", "w": "rad/s"},
    inputs={"volt": "V"},
    params={
        "K": Param(1.0, "rad/s/V", 0.5, 2.0),
        "tau": Param(0.05, "s", 0.02, 0.15),
    },
    derivative=lambda s, a, p: {"q": s.w, "w": (p.K * a.volt - s.w) / p.tau},
)
JOINT = "joint_friction:volt<-w"
FRICTION, K, TAU = 0.35, 0.88, 0.06


@pytest.fixture(scope="module")
def motor():
    """The search of a motor driven to and fro with stops, whose gear holds it at rest."""
    rng, found, t, h = np.random.default_rng(1), [], DT * np.arange(150), 1e-3
    for k in range(4):
        u = (1.0 + 0.3 * k) * np.sin((2.0 + 0.7 * k) * t) * (np.sin(1.3 * t + k) > -0.4)
        x, rows = np.zeros(2), [np.zeros(2)]
        for volt in u:
            for _ in range(20):
                w, brake = x[1] + h * (K * volt - x[1]) / TAU, h * K * FRICTION / TAU
                w -= np.clip(w, -brake, brake)
                x = np.array([x[0] + h * w, w])
            rows.append(x)
        found.append(logged(MOTOR, rows, u, DT, [5e-4, 0.01], rng))
    data, library = prepare(MOTOR, found), Library()
    candidates = library.candidates(MOTOR, data.scales)
    search = HypothesisSearch(data, candidates, joints=library.joints(MOTOR, data.scales))
    search.nulls()
    return search


def fitted(motor, *effects, start=(-0.1, 0.01)):
    """A hypothesis of effects with values, refined from a start of its own."""
    h = Hypothesis(shift=np.array(start), spread=1.0)
    for effect, values in effects:
        h = h.plus(effect, {**effect.fixed, **values})
    return motor.refined([motor.fresh(h)], 30)[0]


def test_a_friction_that_holds_a_joint_takes_the_place_of_one_that_does_not(motor):
    """A motor that a knob turned to and fro: a time constant of 0.073 +- 0.0003 s, truly 0.070 s.

    Its friction holds it at rest, and an added rate can't.
    """
    effects = {e.name: e for e in motor.candidates}
    fit = fitted(motor, (effects["coulomb_friction:w"], {"c": 5.2}))
    motor.fits = {key: one for key, one in motor.fits.items() if key[2] != (JOINT,)}
    held = varied(motor, fit)
    assert held.hypothesis.names == (JOINT,)
    assert motor.score(held) > motor.score(fit) + 20
    assert held.hypothesis.values[0]["c"] == pytest.approx(FRICTION, rel=0.03)


def test_two_names_of_one_friction_are_compared_with_one(motor):
    effects = {e.name: e for e in motor.candidates}
    h = Hypothesis().plus(effects["coulomb_friction:w"], {"c": 5.2})
    assert [one.names for one in variations(motor, h)] == [(JOINT,)]
    h = h.plus(effects["stiction:w"], {"c": 5.0}).plus(effects["quadratic_drag:w"], {"k": 0.1})
    forms = {frozenset(one.names): one for one in variations(motor, h)}
    plain = forms[frozenset({JOINT, "quadratic_drag:w"})]
    assert plain.values[plain.names.index(JOINT)]["c"] == pytest.approx(5.2 * 0.05, rel=0.01)


def test_a_friction_at_its_plainest_has_no_plainer_form(motor):
    joint = motor.joints["w"]
    both = tuple(replace(q, fixed=False) if q.name == "b" else q for q in joint.quantities)
    viscous = replace(joint, quantities=both)
    values = {**joint.fixed, "c": FRICTION, "b": 0.0}
    dearer = motor.price(viscous, values) - motor.price(joint, values)
    assert dearer == pytest.approx(0.5 * np.log(motor.N))
    fit = fitted(motor, (viscous, values), start=(-0.1, 0.01))
    fit = replace(fit, hypothesis=replace(fit.hypothesis, values=(values,)))
    plain = varied(motor, fit)
    assert "b" in plain.hypothesis.effects[0].fixed
    assert not list(variations(motor, plain.hypothesis))


def test_open_loop_predictions_of_an_unstable_plant_run_away():
    """Balanced by a feedback for four seconds: errors grow by exp(5 t), the log stays small."""

    def balanced(k):
        return Model(
            states={"x": "m", "v": "m/s"},
            inputs={"u": "m/s^2"},
            params={"k": Param(k)},
            derivative=lambda s, a, p: {"x": s.v, "v": p.k * s.x + a.u},
        )

    rng, trials = np.random.default_rng(0), []
    for _ in range(3):
        x, inputs = np.array([[0.05, 0.0]]), []
        for k in range(80):
            u = -60 * x[-1, 0] - 12 * x[-1, 1] + np.sin(0.2 * k) + rng.normal(0, 0.3)
            inputs.append([u])
            x = np.r_[x, stepped(balanced(27.0), [u], 0.05, x[-1])[1:]]
        trials.append(logged(balanced(25.0), x, inputs, 0.05, 1e-3, rng))
    options = DiagnosisOptions(library=library("input_bias"), max_effects=1)
    rows = diagnose(balanced(25.0), trials, options).prediction_error
    assert rows[-1].whole_trial and set(rows[-1].runs_away["crude"]) == {"x", "v"}
    assert rows[-1].crude["x"] > 1e3 and not rows[0].runs_away


def test_fits_start_from_every_local_maximum_of_the_scan():
    effect = Library().effect("delay:throttle", car)
    gains = [3.0, 1.0, 90.0, 100.0, 95.0, 2.0, 4.0, 5.0, 1.0, -2.0, -1.0]
    grid = sorted(effect.free[0].grid)
    looks = [(gain, {"d": d}) for gain, d in zip(gains, grid, strict=False)]
    found = elsewhere(effect, sorted(looks, key=lambda look: -look[0]))
    assert found == ({"d": grid[7]}, {"d": grid[0]})


def test_a_late_position_is_tried_with_a_filter_of_its_own():
    cart = Model(
        states={"x": "m", "v": "m/s"},
        inputs={"u": "m/s^2"},
        derivative=lambda s, a, p: {"x": s.v, "v": a.u},
    )
    rng, trials = np.random.default_rng(3), []
    for _ in range(3):
        u = np.repeat(rng.uniform(-1, 1, 15), 10)
        v = np.concatenate([[0.0], np.cumsum(0.02 * u)]) + 5.0
        x = np.concatenate([[0.0], np.cumsum(0.02 * v[:-1])])
        late = x - 0.05 * v + 0.01 * rng.standard_normal(151)
        states = np.column_stack([late, v + 0.01 * rng.standard_normal(151)])
        trials.append(logged(cart, states, u, 0.02))
    data = prepare(cart, trials)
    search = HypothesisSearch(data, Library().candidates(cart, data.scales))
    null = search.nulls()
    starts = search.late_sensors(null)
    assert [h.names for h, _, _ in starts] == [("sensor_delay:x",)]
    (fit,) = search.refined(starts, 12)
    assert search.score(fit) > search.score(null) + 3
    assert fit.hypothesis.values[0]["d"] == pytest.approx(0.05, abs=0.015)


def test_a_state_that_is_set_outright_has_no_rate_to_be_scaled():
    model = Model(
        states={"w": "rad/s"},
        inputs={"steering": "1"},
        params={"k": Param(1.0, "rad/s", std=0.3)},
        step=lambda s, a, p, dt: {"w": p.k * a.steering + 0 * s.w},
    )
    names = [effect.name for effect in Library().candidates(model)]
    assert "rate_gain:w" not in names and "offset:w" in names
    assert "rate_gain:omega" in [effect.name for effect in Library().candidates(pendulum)]


def test_a_scan_of_a_few_runs_at_a_time_is_that_of_all_at_once(monkeypatch):
    rng, (B, T) = np.random.default_rng(2), (5, 60)
    trials = [
        logged(car, 0.1 * rng.normal(size=(T + 1, car.n)), rng.normal(size=(T, car.m)), 0.05)
        for _ in range(B)
    ]
    data = prepare(car, trials)
    candidates = Library().candidates(car, data.scales)
    search = HypothesisSearch(data, candidates)
    kinds = (Hypothesis(), Hypothesis().plus(Library().effect("sensor_delay:x", car), {"d": 0.07}))
    fits = search.refined([search.fresh(kinds[0])], 2) + search.refined([search.fresh(kinds[1])], 2)
    for fit in fits:
        found = []
        for most in (1, 1e9):
            monkeypatch.setattr(scan, "CACHED", most)
            found.append(scan.scan_candidates(search.predictor, fit, candidates))
        gains = np.array([[look.gain for look in looks] for looks in found])
        np.testing.assert_allclose(*gains, rtol=1e-6, atol=1e-6)
        assert (gains[0] > 0.1).sum() > 10
