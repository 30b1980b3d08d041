"""Recovers known parameters with correct intervals, and reports unidentified ones."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from facts import holding
from grounded.diagnosis.validation.choose import Gain
from grounded.errors import GroundedError
from grounded.fit import fit
from grounded.model import Model, Param
from grounded.models.pendulum import model as pendulum
from grounded.trial import Trial

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


def shared():
    """The folder of real data: beside the checkout, or in GROUNDED_SHARED."""
    if "GROUNDED_SHARED" in os.environ:
        return Path(os.environ["GROUNDED_SHARED"])
    for folder in Path(__file__).resolve().parents:
        if (folder / "shared" / "data").is_dir():
            return folder / "shared"
    pytest.skip("no ../shared with real data")


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
    assert not dataclasses.replace(found, nats=0.0).helps

    def judged(mean, whole=0.0):
        gain, loss = (
            Gain(m, m, np.full(2, m), (m, 0.02), (w, 0.001))
            for m, w in ((mean, whole), (-mean, -whole))
        )
        return dataclasses.replace(found, gain=gain, loss=loss)

    assert judged(0.5).helps and not judged(0.5).worse
    assert judged(-0.5).worse and not judged(-0.5).helps
    assert not judged(0.005).helps and not judged(-0.005).worse
    assert judged(0.5, -0.5).worse and not judged(0.5, -0.5).helps
    moved = dataclasses.replace(found.params["d"], value=0.0, identified=True)
    assert "d" in dataclasses.replace(found, params={"d": moved}).at_bounds


def test_the_real_dart_car_has_a_dead_zone():
    data = np.load(shared() / "data" / "dart_small_car" / "throttle_steps_rubber_10Hz.npz")
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
