"""A fit recovers parameters with correct intervals; what the data can't tell is named."""

from dataclasses import replace

import numpy as np
import pytest

from facts import holding, of_code
from grounded import Model, Param, Trial
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.validation.choose import Gain
from grounded.diagnosis.validation.identifiable import identified
from grounded.effects import Library
from grounded.effects.sensor import lagging
from grounded.errors import GroundedError
from grounded.fit import fit
from grounded.models.pendulum import model as pendulum
from shared_data import data as shared_file
from stepped import levels, library, logged, stepped

DT = 0.05
SPRING = Model(
    name="spring",
    states={"x": "m", "v": "m/s"},
    inputs={"force": "N"},
    params={"k": Param(4.0, "1/s^2", 0.1, 20.0), "d": Param(0.5, "1/s", 0.0, 5.0)},
    derivative=lambda s, a, p: {"x": s.v, "v": a.force - p.k * s.x - p.d * s.v},
)
STALLING = Model(
    states={"v": "m/s"},
    inputs={"throttle": "1"},
    params={
        "gain": Param(2.0, "m/s", 0.1, 10.0),
        "tau": Param(0.4, "s", 0.05, 3.0),
        "stall": Param(0.31, "1", 0.0, 0.8),
    },
    derivative=lambda s, a, p: {
        "v": (p.gain * np.where(a.throttle > p.stall, a.throttle, 0.0) - s.v) / p.tau
    },
)
NOISE, CALM = ((0.002, 0.02), (0.01, 0.05)), ((0.005,), (0.02,))


def simulated(model, seed, noise, *, B=4, T=150, latency=0.0, low=-1.0, high=1.0, parts=20):
    """Return trials of random steps; noise: standard deviations of process and measurement."""
    rng, p = np.random.default_rng(seed), model.values
    u = np.repeat(rng.uniform(low, high, (T // 10 + 1, B, model.m)), 10, axis=0)[:T]
    late, x = round(latency / DT * parts), np.zeros((T + 1, B, model.n))
    received = np.concatenate([np.zeros((late, B, model.m)), np.repeat(u, parts, axis=0)])
    parts = parts if latency else 1
    for t in range(T):
        z = x[t]
        for k in range(parts):
            sent = received[t * parts + k] if latency else u[t]
            z = model.system.step(z, sent, p, DT / parts)
        x[t + 1] = z + np.array(noise[0]) * rng.standard_normal(z.shape)
    y, names = x + np.array(noise[1]) * rng.standard_normal(x.shape), (model.state_names,)
    held = {"input_names": model.input_names, "start_inputs": np.zeros(model.m)}
    return [Trial(y[:, b], u[:, b], DT, *names, **held) for b in range(B)]


LOUD = ((1e-4, 1e-3), (0.03, 0.2))


@pytest.mark.parametrize(
    ("model", "start", "made", "options"),
    [
        (SPRING, {"k": 9.0, "d": 2.0}, {"noise": NOISE, "B": 6}, {}),
        (SPRING, {}, {"noise": LOUD, "B": 8}, {}),  # one-step least squares finds a drag of 1.0
        (SPRING, {"k": 5.0}, {"noise": NOISE, "latency": 0.1}, {"delays": {"latency:force": (0,)}}),
        (SPRING, {"k": 5.0}, {"noise": NOISE, "latency": 0.13}, {"delays": {"latency": (0,)}}),
        (STALLING, {"stall": 0.1, "gain": 1.5}, {"noise": CALM, "B": 8, "low": 0.0}, {}),
    ],
)
def test_parameters_delays_and_thresholds_are_recovered(model, start, made, options):
    found = fit(model.with_values(start), simulated(model, 2, **made), **options)
    true = {n: p.value for n, p in model.params.items()}
    true |= {n: made.get("latency") for n in ("latency", "latency:force")}
    assert found.status == "converged" and found.helps == bool(start) and not found.at_bounds
    for name, e in found.params.items():
        assert e.identified and abs(e.value - true[name]) < 3 * e.std < 0.6 * true[name]
        assert e.low < e.value < e.high
    assert all(found.model.params[n].value == found.params[n].value for n in model.params)
    if options:
        assert found.latency[0] == [*found.params.values()][-1].value
    if start:
        row = found.prediction_error[-1]
        assert all(row.with_effects[name] < 0.7 * was for name, was in row.crude.items())


def test_intervals_cover_the_truth_as_often_as_they_say():
    inside = total = 0
    for seed in range(12):
        found = fit(SPRING.with_values({"k": 5.0}), simulated(SPRING, seed, NOISE, B=3, T=100))
        for name, value in (("k", 4.0), ("d", 0.5)):
            inside += found.params[name].low <= value <= found.params[name].high
            total += 1
    assert inside >= 0.85 * total


def test_what_the_data_cannot_tell_is_named():
    trials = simulated(pendulum, 4, ((1e-3, 1e-2), (5e-3, 2e-2)), T=100)
    found = fit(pendulum, trials)  # three: torque/(m l^2), b/(m l^2), g/l
    assert not found.params["g"].identified  # the one with the narrowest bounds is held
    assert np.isinf(found.params["g"].std) and found.params["g"].value == 9.81
    assert all(found.params[name].identified for name in "mlb")
    assert "g" in found.params["l"].only_with
    known = fit(pendulum, trials, ["m", "l", "b"])
    assert all(estimate.identified for estimate in known.params.values())
    assert abs(known.params["l"].value - 0.5) < 3 * known.params["l"].std


def test_a_constant_input_identifies_no_gain_and_no_delay_of_it():
    model = Model(
        states=dict(SPRING.states),
        inputs=dict(SPRING.inputs),
        params={"gain": Param(1.0, "1", 0.0, 3.0), "d": Param(0.5, "1/s", 0.0, 5.0)},
        derivative=lambda s, a, p: {"x": s.v, "v": p.gain * a.force - 4.0 * s.x - p.d * s.v},
    )
    trials = simulated(SPRING, 5, NOISE, low=0.0, high=0.0)
    found = fit(model, trials, delays={"latency:force": (0,)})
    for name in ("gain", "latency:force"):
        assert not found.params[name].identified and np.isinf(found.params[name].std)
        assert any(name in one.about for one in found.findings if one.code == "model.not_told")


def test_a_model_that_runs_away_is_refused():
    model = Model(
        states=dict(SPRING.states),
        inputs=dict(SPRING.inputs),
        params={"k": Param(4.0, "1", std=1.0)},
        derivative=lambda s, a, p: {"x": s.v, "v": a.force * 1e300 * np.exp(1e3 * p.k)},
    )
    with pytest.raises(GroundedError) as refused:
        fit(model, simulated(SPRING, 9, NOISE, B=1))
    assert refused.value.finding.code == "model.not_finite"


def test_misuse_says_what_to_do():
    trials = simulated(SPRING, 10, NOISE, B=1, T=20)
    with pytest.raises(GroundedError, match=holding("'kk'")):
        fit(SPRING, trials, ["kk"])
    with pytest.raises(GroundedError, match=holding("fit", 3)):
        fit(SPRING, [Trial(np.zeros((2, 2)), np.zeros((1, 1)), DT, ("x", "v"), ("force",))])


def test_held_out_errors_decide_whether_a_fit_helps():
    found = fit(SPRING.with_values({"k": 9.0}), simulated(SPRING, 0, NOISE, B=1, T=60))
    assert found.gain is None and not found.worse and found.helps  # nothing was held out
    assert not replace(found, nats=0.0).helps

    def judged(mean, whole=0.0):
        gain, loss = (
            Gain(m, m, np.full(2, m), (m, 0.02), (w, 0.001))
            for m, w in ((mean, whole), (-mean, -whole))
        )
        return replace(found, gain=gain, loss=loss)

    assert judged(0.5).helps and not judged(0.5).worse
    assert judged(-0.5).worse and not judged(-0.5).helps
    assert not judged(0.005).helps and not judged(-0.005).worse
    assert judged(0.5, -0.5).worse and not judged(0.5, -0.5).helps
    moved = replace(found.params["d"], value=0.0, identified=True)
    assert "d" in replace(found, params={"d": moved}).at_bounds


def test_the_real_dart_car_has_a_dead_zone():
    data = np.load(shared_file("dart_small_car", "throttle_steps_rubber_10Hz.npz"))
    column = list(data["columns"]).index
    trials = []
    for run in range(len(data["files"])):
        rows = data[f"run{run:02d}"].astype(float)
        throttle = rows[:, column("throttle")] * (rows[:, column("safety_value")] > 0)
        speed = rows[:, column("vel encoder")]
        trials.append(Trial(speed[:, None], throttle[:-1, None], 0.1, ("v",), ("throttle",)))
    model = Model(
        name="dart",
        states={"v": "m/s"},
        inputs={"throttle": "1"},
        params={
            "gain": Param(5.0, "m/s", 0.5, 30.0),
            "tau": Param(0.5, "s", 0.05, 5.0),
            "dead": Param(0.0, "1", 0.0, 0.4),
        },
        derivative=lambda s, a, p: {
            "v": (p.gain * np.maximum(a.throttle - p.dead, 0.0) - s.v) / p.tau
        },
    )
    plain, found = fit(model, trials, ["gain", "tau"]), fit(model, trials)
    assert 0.12 < found.params["dead"].value < 0.22 and found.params["dead"].std < 0.02
    assert found.loglik > plain.loglik + 100
    less, more = (one.prediction_error[-1].with_effects["v"] for one in (found, plain))
    assert less < 0.7 * more


def test_a_filter_of_speeds_is_not_fitted_as_friction(dt=0.02):
    """Positions quantised to 0.05 mm, and speeds that a sensor filters by 30 ms."""
    axis = Model(
        name="axis",
        states={"x": "m", "v": "m/s"},
        inputs={"volts": "V"},
        params={
            "k": Param(2.0, "m/s^2/V", 0.5, 8.0),
            "b": Param(3.0, "1/s", 0.1, 20.0),
            "c": Param(0.0, "m/s^2", 0.0, 2.0),
        },
        roles={"position": ("x",), "speed": "v"},
        derivative=lambda s, a, p: {
            "x": s.v,
            "v": p.k * a.volts - p.b * s.v - p.c * np.tanh(s.v / 0.02),
        },
        substeps=4,
    )
    true, rng, trials = {"k": 4.0, "b": 6.0, "c": 0.5}, np.random.default_rng(0), []
    for _ in range(3):
        volts = levels(rng, 20, 10)
        x, v = stepped(axis.with_values(true), volts, dt).T
        off, shown = 0.0, v.copy()
        for t in range(1, len(v)):
            off = lagging(off, v[t] - v[t - 1], 0.03, dt)
            shown[t] += off
        states = np.column_stack([np.round(x / 5e-5) * 5e-5, shown])
        trials.append(logged(axis, states, volts, dt, [0.0, 1e-3], rng))
    found = fit(replace(axis, substeps=1), trials)
    assert [one.kind for one in found.preflight if one.corrected] == ["lag"]
    for name, value in true.items():
        assert found.params[name].value == pytest.approx(value, rel=0.03)
        assert found.params[name].low < value < found.params[name].high
    assert tuple(found.prediction_error[-1].crude) == axis.state_names
    assert found.helps and {*found.params} == {*true}


def motor(**params):
    return Model(
        states={"v": "m/s"},
        inputs={"u": "N"},
        params=params,
        derivative=lambda s, a, p: {"v": (p.gain * a.u - p.drag * s.v) / p.mass},
    )


@pytest.fixture(scope="module")
def trials():
    real = motor(mass=Param(2.0), gain=Param(3.0), drag=Param(0.5))
    rng = np.random.default_rng(3)
    sent = [levels(rng, 7, 8) for _ in range(3)]
    return [logged(real, stepped(real, u, DT), u, DT, 1e-3, rng) for u in sent]


@pytest.mark.slow
def test_a_constant_is_neither_fitted_nor_blamed_nor_calibrated(trials):
    model = motor(mass=Param(2.0, "kg"), gain=Param(3.0), drag=Param(0.3, "N s/m", 0.0, 2.0))
    found = fit(model, trials)
    assert list(found.params) == ["drag"] and found.params["drag"].value == pytest.approx(0.5, 0.1)
    assert found.model.params["mass"] == model.params["mass"]
    with pytest.raises(GroundedError, match="'mass'"):
        fit(model, trials, ["mass"])
    diagnosis = diagnose(model, trials)
    assert set(diagnosis.parameters) <= {"drag"}
    assert not {"parameter:mass", "parameter:gain"} & {row.effect for row in diagnosis.ranking}
    assert [one.parameter for one in diagnosis.identifiable] == ["drag"]
    constants = motor(mass=Param(2.0), gain=Param(3.0), drag=Param(0.3))
    with pytest.raises(GroundedError, match=holding(f"'{constants.name}'")):
        fit(constants, trials)


@pytest.mark.slow
def test_of_a_combination_the_surest_parameter_stays(trials):
    """Only gain / mass and drag / mass are identified."""
    model = motor(
        mass=Param(2.0, "kg", std=0.1), gain=Param(2.5, std=0.5), drag=Param(0.4, std=0.2)
    )
    found = fit(model, trials)
    assert not found.params["mass"].identified and found.params["mass"].value == 2.0
    assert found.params["gain"].identified and found.params["gain"].value == pytest.approx(3, 0.03)
    assert found.params["gain"].only_with == found.params["drag"].only_with == ("mass",)
    (one,) = [one for one in found.findings if one.code == "model.given"]
    assert one.facts["rests"] == ("mass",)
    diagnosis = diagnose(model, trials)
    verdicts = {one.parameter: one.verdict for one in diagnosis.identifiable}
    assert verdicts["mass"] == "not identifiable"
    assert "mass" not in diagnosis.known_parameters


def test_a_parameter_that_is_found_off_is_identified_by_what_shows_that(trials):
    model = motor(mass=Param(2.0), gain=Param(2.0, "1", 0.1, 20), drag=Param(0.5, "1", 0.05, 10))
    data = prepare(model, trials, np.zeros(1))
    search = HypothesisSearch(data, Library().candidates(model, data.scales))
    search.nulls()
    off = Library().effect("parameter:gain", model, data.scales)
    start = search.fresh(Hypothesis(shift=np.zeros(3), spread=1.0).plus(off, {"d": 1.0}))
    (found, *_) = search.refined([start], 12)
    assert found.hypothesis.values[0]["d"] == pytest.approx(1.0, abs=0.1)
    verdicts = {
        one.parameter: one.verdict for one in identified(search.predictor, found).parameters
    }
    assert verdicts == {"gain": "identifiable", "drag": "identifiable"}


def test_parameters_that_are_known_only_together_are_written_together():
    """At speeds near 1, two drags of 0.6 show nearly as one."""
    model = Model(
        states={"v": "m/s"},
        inputs={"u": "N"},
        params={"a": Param(0.5, std=0.1), "b": Param(0.5, std=0.1)},
        derivative=lambda s, a, p: {"v": a.u - p.a * s.v - p.b * s.v**2},
    )
    rng, real, drags = np.random.default_rng(5), model.with_values({"a": 0.6, "b": 0.6}), []
    for _ in range(4):
        u = 1.2 + levels(rng, 10, 8, 0.1)
        drags.append(logged(model, stepped(real, u, DT, [1.0]), u, DT, 0.02, rng))
    diagnosis = diagnose(model, drags, DiagnosisOptions(library=library("offset")))
    assert [c.of for c in diagnosis.credit] == ["calibration"]
    assert {i.verdict for i in diagnosis.identifiable} == {"not identifiable"}
    assert diagnosis.jointly == {"a", "b"} == set(diagnosis.known_parameters)
    total = sum(e.value for e in diagnosis.known_parameters.values())
    assert total == pytest.approx(1.2, abs=0.01)
    written = diagnosis.to_json()["identifiable"]
    assert all(one["jointly"] for one in written)
    (one,) = of_code(diagnosis, "model.given")
    assert one.about == ("a", "b")
