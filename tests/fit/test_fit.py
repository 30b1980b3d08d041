"""Recovers known parameters with correct intervals, and reports unidentified ones."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from facts import holding, holds
from grounded.errors import GroundedError
from grounded.estimate import NoiseStd, Record, of_states, record_of
from grounded.estimate.extended import filter_batch
from grounded.estimate.steps import ModelSteps
from grounded.fit import PredictionError, fit, prediction_error
from grounded.fit.gauss_newton import climb, marquardt_step
from grounded.fit.point import FitData, Linear, differenced, exact, linear, point, whitened
from grounded.fit.result import beside_bounds, uncertainty
from grounded.fit.unknowns import unknowns_of
from grounded.model import Model, Param
from grounded.models.pendulum import model as pendulum
from grounded.trial import Trial

DT = 0.05


def _spring(s, a, p):
    return {"x": s.v, "v": a.force - p.k * s.x - p.d * s.v}


SPRING = Model(
    name="spring",
    states={"x": "m", "v": "m/s"},
    inputs={"force": "N"},
    params={"k": Param(4.0, "1/s^2", 0.1, 20.0), "d": Param(0.5, "1/s", 0.0, 5.0)},
    derivative=_spring,
)
NOISE = NoiseStd(np.array([0.002, 0.02]), np.array([0.01, 0.05]), DT)


def simulated(model, rng, noise, *, B=4, T=150, latency=0.0, low=-1.0, high=1.0):
    system, p, dt = model.system, model.values, noise.dt
    u = np.repeat(rng.uniform(low, high, (T // 10 + 1, B, model.m)), 10, axis=0)[:T]
    x = np.zeros((T + 1, B, model.n))
    names = (model.state_names, model.input_names)
    trials = [Trial(x[:, b], u[:, b], dt, *names) for b in range(B)]
    received = np.stack(
        [record_of(model, t).received(np.full(model.m, latency))[0] for t in trials], axis=1
    )
    for t in range(T):
        w = noise.process * rng.standard_normal((B, model.n))
        x[t + 1] = system.step(x[t], received[t], p, dt) + w
    y = x + noise.measurement * rng.standard_normal(x.shape)
    return [Trial(y[:, b], u[:, b], dt, *names) for b in range(B)]


def shared():
    """The folder of real data: beside the checkout, or in GROUNDED_SHARED."""
    if "GROUNDED_SHARED" in os.environ:
        return Path(os.environ["GROUNDED_SHARED"])
    for folder in Path(__file__).resolve().parents:
        if (folder / "shared" / "data").is_dir():
            return folder / "shared"
    pytest.skip("no ../shared with real data")


def test_parameters_and_noise_are_recovered_from_a_wrong_start():
    trials = simulated(SPRING, np.random.default_rng(0), NOISE, B=6)
    found = fit(SPRING.with_values({"k": 9.0, "d": 2.0}), trials)
    assert found.status == "converged"
    for name, value in (("k", 4.0), ("d", 0.5)):
        estimate = found.params[name]
        assert estimate.identified
        assert abs(estimate.value - value) < 3 * estimate.std < 0.5 * value
        assert estimate.low < estimate.value < estimate.high
    assert np.allclose(found.noise.measurement, NOISE.measurement, rtol=0.2)
    assert found.model.params["k"].value == found.params["k"].value
    assert found.before is not None
    assert (found.after.ahead < 0.7 * found.before.ahead).all()


def test_intervals_cover_the_truth_as_often_as_they_say():
    inside = total = 0
    for seed in range(12):
        trials = simulated(SPRING, np.random.default_rng(100 + seed), NOISE, B=3, T=100)
        found = fit(SPRING.with_values({"k": 5.0}), trials, hold_out=0.0)
        for name, value in (("k", 4.0), ("d", 0.5)):
            inside += found.params[name].low <= value <= found.params[name].high
            total += 1
    assert inside >= 0.85 * total


def test_noise_of_the_measurements_does_not_bias_the_fit():
    noisy = NoiseStd(np.array([1e-4, 1e-3]), np.array([0.03, 0.2]), DT)
    trials = simulated(SPRING, np.random.default_rng(1), noise=noisy, B=8)
    found = fit(SPRING, trials, hold_out=0.0)
    assert abs(found.params["d"].value - 0.5) < 3 * found.params["d"].std < 0.1

    # one-step least squares on the raw samples, for comparison: it finds a drag that isn't there
    x = np.vstack([t.states[:-1] for t in trials])
    rate = np.concatenate([np.diff(t.states[:, 1]) / DT - t.inputs[:, 0] for t in trials])
    drag = -np.linalg.lstsq(x, rate, rcond=None)[0][1]
    assert drag > 1.0


@pytest.mark.parametrize("latency", [0.1, 0.13])
def test_a_latency_of_any_fraction_is_found_from_none(latency):
    trials = simulated(SPRING, np.random.default_rng(2), NOISE, B=6, latency=latency)
    found = fit(SPRING.with_values({"k": 5.0}), trials, fit_latency="each", hold_out=0.0)
    estimate = found.params["latency:force"]
    assert estimate.unit == "s"
    assert abs(estimate.value - latency) < 3 * estimate.std < 0.03
    assert found.latency[0] == estimate.value


def _stalling(s, a, p):
    drive = np.where(a.throttle > p.stall, a.throttle, 0.0)
    return {"v": (p.gain * drive - s.v) / p.tau}


STALLING = Model(
    states={"v": "m/s"},
    inputs={"throttle": "1"},
    params={
        "gain": Param(2.0, "m/s", 0.1, 10.0),
        "tau": Param(0.4, "s", 0.05, 3.0),
        "stall": Param(0.31, "1", 0.0, 0.8),
    },
    derivative=_stalling,
)


def test_a_threshold_is_found_by_scanning():
    noise = NoiseStd(np.array([0.005]), np.array([0.02]), DT)
    trials = simulated(STALLING, np.random.default_rng(3), noise, B=8, low=0.0)
    found = fit(STALLING.with_values({"stall": 0.1, "gain": 1.5}), trials, hold_out=0.0)
    stall = found.params["stall"]
    assert stall.identified
    assert stall.low <= 0.31 <= stall.high
    assert stall.high - stall.low < 0.05
    assert abs(found.params["gain"].value - 2.0) < 3 * found.params["gain"].std


def test_correlated_disturbances_widen_intervals_of_thresholds_too():
    """An unmodelled wind: intervals that assume white noise would be far too narrow."""
    calm = NoiseStd(np.array([0.005]), np.array([0.02]), DT)
    widths = {}
    for wind in (0.0, 0.15):
        covered, each = 0, []
        for seed in range(4):
            rng = np.random.default_rng(seed)
            trials = simulated(STALLING, rng, calm, B=4, low=0.0)
            t = np.arange(len(trials[0].states)) * DT
            gusts = [wind * np.sin(2 * np.pi * t / 2.0 + rng.uniform(0, 6)) for _ in trials]
            trials = [
                dataclasses.replace(trial, states=trial.states + gust[:, None])
                for trial, gust in zip(trials, gusts, strict=True)
            ]
            stall = fit(STALLING, trials, ["stall", "gain"], hold_out=0.0).params["stall"]
            covered += stall.low <= 0.31 <= stall.high
            each.append(stall.high - stall.low)
        widths[wind] = np.median(each)
        assert covered >= 3
    assert widths[0.15] > 1.5 * widths[0.0]


def test_what_the_data_cannot_tell_is_named():
    noise = NoiseStd(np.array([1e-3, 1e-2]), np.array([5e-3, 2e-2]), DT)
    trials = simulated(pendulum, np.random.default_rng(4), noise, B=4, T=100)
    found = fit(pendulum, trials, hold_out=0.0)  # three: torque/(m l^2), b/(m l^2), g/l
    assert not found.params["g"].identified  # the one with the narrowest bounds is held
    assert np.isinf(found.params["g"].std) and found.params["g"].value == 9.81
    assert all(found.params[name].identified for name in "mlb")
    known = fit(pendulum, trials, ["m", "l", "b"], hold_out=0.0)
    assert all(estimate.identified for estimate in known.params.values())
    assert abs(known.params["l"].value - 0.5) < 3 * known.params["l"].std


def test_a_constant_input_identifies_no_gain_of_it():
    trials = simulated(SPRING, np.random.default_rng(5), NOISE, low=0.0, high=0.0)

    def driven(s, a, p):
        return {"x": s.v, "v": p.gain * a.force - 4.0 * s.x - p.d * s.v}

    model = Model(
        states=dict(SPRING.states),
        inputs=dict(SPRING.inputs),
        params={"gain": Param(1.0, "1", 0.0, 3.0), "d": Param(0.5, "1/s", 0.0, 5.0)},
        derivative=driven,
    )
    found = fit(model, trials, hold_out=0.0)
    assert not found.params["gain"].identified
    assert np.isinf(found.params["gain"].std)
    assert holds(found.sentence, "gain")


def test_slopes_of_the_problem_are_what_differences_say():
    trials = simulated(SPRING, np.random.default_rng(6), NOISE, B=2, T=40)
    measurement = of_states(SPRING)
    unknowns = unknowns_of(SPRING, None, np.array([0.06]), "each")
    records = tuple(record_of(SPRING, t) for t in trials)
    data = FitData(SPRING.system, records, measurement, unknowns)

    def filtered(theta):
        batch, p = data.batch(theta), unknowns.unpack(theta)[0]
        return filter_batch(batch, measurement, NOISE, ModelSteps(SPRING.system, p, batch, True))

    start, seen = unknowns.start, data.batch(unknowns.start).seen
    at = filtered(start)
    W, slopes = (
        whitened(data, data.batch(start), start, at)[seen],
        linear(data, point(data, NOISE, start)),
    )
    assert np.allclose(slopes.N, W.T @ W)
    assert np.allclose(slopes.g, -W.T @ at.eps[seen]) and np.allclose(
        -slopes.scores.sum(0), slopes.g
    )
    for i, h in enumerate((1e-4, 1e-4, 1e-5)):
        up, down = (filtered(start + s * np.eye(3)[i]) for s in (h, -h))
        # S depends on k and d, eps = C e through C as well: compare the innovations themselves
        e = (up.e - down.e) / (2 * h)
        moved = (at.gains.whitener @ e[..., None])[..., 0][seen]
        assert np.corrcoef(moved, W[:, i])[0, 1] > 0.97


def test_a_climb_goes_on_where_only_the_gains_say_which_way_is_up():
    lag = Model(
        name="lag",
        states={"w": "rad/s"},
        inputs={"u": "rad/s"},
        params={"rate": Param(5.0, "1/s", 0.1, 50.0), "gain": Param(1.0, "1", 0.1, 10.0)},
        derivative=lambda s, a, p: {"w": p.rate * (p.gain * a.u - s.w)},
    )
    noise = NoiseStd(np.array([0.05]), np.array([0.09]), DT)
    trials = simulated(lag, np.random.default_rng(3), noise, B=3, T=120)
    rough, unknowns = NoiseStd([0.002], [0.7], DT), unknowns_of(lag, None, np.zeros(1), "known")
    records = tuple(record_of(lag, t) for t in trials)
    data = FitData(lag.system, records, of_states(lag), unknowns)
    for rate in (0.9, 1.1, 8.0):
        theta = np.array([rate, 0.9])
        g, numbers = exact(data, point(data, rough, theta)).g, []
        for step in 1e-4 * np.eye(2):
            ends = (point(data, rough, theta + sign * step).loglik for sign in (1, -1))
            numbers.append(np.subtract(*ends) / 2e-4)
        assert np.allclose(g, numbers, rtol=1e-3, atol=1e-3)
    ends = [
        climb(data, rough, point(data, rough, np.array([r, 0.9])), np.ones(2, bool), 60)
        for r in (1.0, 5.0)
    ]
    assert ends[0].at.loglik == pytest.approx(ends[1].at.loglik, abs=0.05)
    assert ends[0].at.theta == pytest.approx(ends[1].at.theta, rel=0.1)


def test_a_black_box_step_is_fitted_all_the_same():
    import math

    def step(s, a, p, dt):
        if a["u"] > 0:  # neither traceable nor batchable
            return {
                "y": math.exp(-dt / p["tau"]) * s["y"] + (1 - math.exp(-dt / p["tau"])) * a["u"]
            }
        return {"y": math.exp(-dt / p["tau"]) * s["y"]}

    box = Model(
        states={"y": "1"}, inputs={"u": "1"}, params={"tau": Param(0.3, "s", 0.05, 2.0)}, step=step
    )
    noise = NoiseStd(np.array([0.01]), np.array([0.02]), DT)
    trials = simulated(box, np.random.default_rng(7), noise, B=2, T=80)
    found = fit(box.with_values({"tau": 0.6}), trials, hold_out=0.0)
    assert abs(found.params["tau"].value - 0.3) < 3 * found.params["tau"].std < 0.15


def test_prediction_error_falls_to_the_noise_for_the_true_model():
    quiet = NoiseStd(np.array([1e-5, 1e-5]), np.array([0.01, 0.05]), DT)
    trials = simulated(SPRING, np.random.default_rng(8), quiet)
    error = prediction_error(SPRING, trials, 1.0)
    assert np.allclose(error.ahead, quiet.measurement, rtol=0.15)
    assert np.allclose(error.one_step, quiet.measurement, rtol=0.15)
    assert error.windows == 4 * (150 - 20 + 1)
    wrong = prediction_error(SPRING.with_values({"k": 8.0}), trials, 1.0)
    assert (wrong.ahead > 3 * error.ahead).all()
    short = prediction_error(SPRING, trials, 60.0)
    assert short.windows == 0
    assert np.isnan(short.ahead).all()


def test_a_model_that_runs_away_is_a_status():
    trials = simulated(SPRING, np.random.default_rng(9), NOISE, B=1)

    def explosive(s, a, p):
        return {"x": s.v, "v": a.force * 1e300 * np.exp(1e3 * p.k)}

    model = Model(
        states=dict(SPRING.states),
        inputs=dict(SPRING.inputs),
        params={"k": Param(4.0, "1", std=1.0)},
        derivative=explosive,
    )
    found = fit(model, trials)
    assert not found.params["k"].identified


def test_misuse_says_what_to_do():
    trials = simulated(SPRING, np.random.default_rng(10), NOISE, B=1, T=20)
    with pytest.raises(GroundedError, match=holding("'kk'")):
        fit(SPRING, trials, ["kk"])
    with pytest.raises(GroundedError, match=holding("known", "common", "each")):
        fit(SPRING, trials, fit_latency="yes")
    with pytest.raises(GroundedError, match=holding("3 steps")):
        fit(SPRING, [Trial(np.zeros((2, 2)), np.zeros((1, 1)), DT, ("x", "v"), ("force",))])


def test_the_same_data_give_the_same_fit():
    trials = simulated(SPRING, np.random.default_rng(11), NOISE, B=2, T=80)
    a, b = (fit(SPRING, trials).params["k"] for _ in range(2))
    assert dataclasses.asdict(a) == dataclasses.asdict(b)


def emps():
    """The EMPS axis: motor, ball screw, carriage with Coulomb and viscous friction."""

    def axis(s, a, p):
        force = 35.15065188 * a.voltage - p.Fv * s.v - p.Fc * np.sign(s.v) - p.offset
        return {"q": s.v, "v": force / p.M}

    return Model(
        name="emps",
        states={"q": "m", "v": "m/s"},
        inputs={"voltage": "V"},
        params={
            "M": Param(80.0, "kg", 20.0, 300.0),
            "Fv": Param(100.0, "N s/m", 0.0, 1000.0),
            "Fc": Param(5.0, "N", 0.0, 100.0),
            "offset": Param(0.0, "N", -20.0, 20.0),
        },
        derivative=axis,
    )


def emps_trial(name, every=10):
    """A run of the axis at 1000 / every Hz; only the position is measured."""
    data = np.load(shared() / "data" / "emps_prismatic_axis" / name)
    T = (len(data["q_m"]) - 1) // every
    states = np.full((T + 1, 2), np.nan)
    states[:, 0] = data["q_m"][: T * every + 1 : every]
    inputs = data["u_motor_V"][: T * every].reshape(T, every).mean(axis=1)[:, None]
    return Trial(states, inputs, every * 1e-3, ("q", "v"), ("voltage",))


@pytest.mark.slow
def test_the_real_emps_axis_against_its_published_values():
    model = emps()
    found = fit(model, [emps_trial("emps_estimation.npz")])
    published = {"M": 95.109, "Fv": 203.5, "Fc": 20.394, "offset": -3.165}
    for name, value in published.items():
        assert found.params[name].identified
        assert found.params[name].value == pytest.approx(value, rel=0.05)
    assert found.after.ahead[0] < found.before.ahead[0] / 20
    validation = [emps_trial("emps_validation_pulses.npz")]
    before, after = (prediction_error(m, validation) for m in (model, found.model))
    assert after.ahead[0] < before.ahead[0] / 20


def test_the_real_dart_car_has_a_dead_zone():
    data = np.load(shared() / "data" / "dart_small_car" / "throttle_steps_rubber_10Hz.npz")
    column = list(data["columns"]).index
    trials = []
    for run in range(len(data["files"])):
        rows = data[f"run{run:02d}"].astype(float)
        throttle = rows[:, column("throttle")] * (rows[:, column("safety_value")] > 0)
        speed = rows[:, column("vel encoder")]
        trials.append(Trial(speed[:, None], throttle[:-1, None], 0.1, ("v",), ("throttle",)))

    def straight(s, a, p):
        return {"v": (p.gain * np.maximum(a.throttle - p.dead, 0.0) - s.v) / p.tau}

    model = Model(
        name="dart",
        states={"v": "m/s"},
        inputs={"throttle": "1"},
        params={
            "gain": Param(5.0, "m/s", 0.5, 30.0),
            "tau": Param(0.5, "s", 0.05, 5.0),
            "dead": Param(0.0, "1", 0.0, 0.4),
        },
        derivative=straight,
    )
    plain = fit(model, trials, ["gain", "tau"])
    found = fit(model, trials)
    assert 0.12 < found.params["dead"].value < 0.22
    assert found.params["dead"].std < 0.02
    assert found.loglik > plain.loglik + 100
    assert found.after.ahead[0] < 0.7 * plain.after.ahead[0]


def test_a_fit_that_predicts_no_better_is_not_recommended():
    """Errors in the table decide: q 0.00694 -> 0.0111 and w 0.0281 -> 0.0382 is worse."""

    def fitted(*ahead):
        made = [PredictionError(("q", "w"), np.full(2, 0.01), np.array(a), 1.0, 9) for a in ahead]
        return dataclasses.replace(found, before=made[0], after=made[1])

    trials = simulated(SPRING, np.random.default_rng(0), NOISE, B=1, T=30)
    found = fit(SPRING, trials, hold_out=0.0)
    worse = fitted((0.00694, 0.0281), (0.0111, 0.0382))
    assert worse.worse and not worse.helps
    tied = fitted((0.01, 0.02), (0.01005, 0.02))
    assert not tied.worse and not tied.helps
    hardly = fitted((0.00267, 0.02), (0.00266, 0.02))  # `next: fit --apply`, again and again
    assert not hardly.worse and not hardly.helps
    better = fitted((0.0111, 0.0382), (0.00694, 0.0281))
    assert better.helps and not better.worse
    assert not found.worse and found.helps  # nothing was held out
    assert not dataclasses.replace(found, loglik=-np.inf).helps  # nothing was fitted
    known = found.model.params
    moved = dataclasses.replace(found.params["d"], value=known["d"].high)
    stopped = dataclasses.replace(found, params={**found.params, "d": moved})
    assert found.at_bounds == ("k",) and stopped.at_bounds == ("k", "d")
    assert fitted((0.01, 0.02), (np.nan, 0.02)).worse


def test_a_gain_that_ties_with_what_is_at_its_bound_is_identified():
    """k and d are tied here; with d at its bound 0, the trials identify k."""
    unknowns = unknowns_of(SPRING, None, np.zeros(1), "known")
    both = Linear(np.full((2, 2), 1e4), np.zeros(2), np.zeros((3, 2)))
    every, inside, at_bound = np.ones(2, bool), np.array([4.0, 0.5]), np.array([4.0, 0.0])
    assert np.isinf(uncertainty(both, every).std).all()
    assert np.isinf(beside_bounds(both, every, unknowns, inside).std).all()
    found = beside_bounds(both, every, unknowns, at_bound)
    assert found.std == pytest.approx([0.01, 0.01]) and not found.together


def test_a_step_that_meets_a_bound_is_the_best_one_with_it_there():
    rng = np.random.default_rng(0)
    data = FitData(
        SPRING.system,
        tuple(record_of(SPRING, t) for t in simulated(SPRING, rng, NOISE, B=1, T=60)),
        of_states(SPRING),
        unknowns_of(SPRING, None, np.zeros(1), "known"),
    )
    N, g = np.array([[1.0, 0.99], [0.99, 1.0]]), np.array([1.0, -1.0])
    step, promise = marquardt_step(
        data, np.array([4.0, 0.0001]), Linear(N, g, np.zeros((1, 2))), np.ones(2, bool), 0.0
    )
    assert step[1] == pytest.approx(-0.0001)
    assert step[0] == pytest.approx(1.0, rel=1e-3) and promise > 0.4


def test_differences_follow_the_likelihood_where_a_hidden_state_bends_the_model():
    """On measured tanks a fit ended though derivatives promised 113 nats: they were wrong."""
    tanks = Model(
        states={"upper": "V", "lower": "V"},
        inputs={"pump": "V"},
        params={name: Param(0.05, "1/s", 0.01, 0.2) for name in "abcd"},
        derivative=lambda s, a, p: {
            "upper": p.d * a.pump - p.a * np.sqrt(np.maximum(s.upper, 1e-3)),
            "lower": p.b * np.sqrt(np.maximum(s.upper, 1e-3))
            - p.c * np.sqrt(np.maximum(s.lower, 1e-3)),
        },
    )
    pump = np.repeat(np.random.default_rng(2).uniform(1.0, 6.0, 8), 25)[:, None]
    states = [np.array([[4.0, 5.0]])]
    for u in pump:
        states.append(
            tanks.system.step(states[-1], u[None], np.array([0.05, 0.04, 0.04, 0.05]), 4.0)
        )
    times, seen = 4.0 * np.arange(201), np.concatenate(states)[:, 1:]
    record = Record(times, seen, times[:-1], pump, pump[0], start=np.zeros(2), start_std=np.ones(2))
    unknowns = unknowns_of(tanks, None, np.zeros(1), "known")
    data = FitData(tanks.system, (record,), of_states(tanks, ["lower"]), unknowns)
    noise, theta = NoiseStd(np.array([0.78, 0.04]), np.array([1e-5]), 4.0), unknowns.start
    at, numbers = point(data, noise, theta), []
    for step in 1e-6 * np.eye(4):
        ends = (point(data, noise, theta + sign * step, at).loglik for sign in (1, -1))
        numbers.append(np.subtract(*ends) / 2e-6)
    assert np.allclose(differenced(data, at).g, numbers, rtol=1e-2, atol=0.5)
    assert not np.allclose(exact(data, at).g, numbers, rtol=0.5, atol=0.5)
