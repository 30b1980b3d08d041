"""Compares the filter with a dense Gaussian, noise and states with truth."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.compile.problem import queue_of
from grounded.estimate import (
    LAST_GAIN,
    NoiseStd,
    Record,
    batch_of,
    filtered,
    process_noise,
    smoothed,
)
from grounded.model import Model, Param
from grounded.models.car import model as car
from grounded.trial import Trial
from stepped import stepped

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
SPRING_NOISE = NoiseStd(np.array([0.002, 0.02]), np.array([0.01, 0.05]), DT)
CAR_NOISE = NoiseStd(
    np.array([0.003, 0.01, 0.001, 0.001, 0.002, 0.02]),
    np.array([0.01, 0.03, 0.003, 0.003, 0.01, 0.05]),
    DT,
)


def simulated(model, rng, noise, *, B=4, T=100, latency=0.0, low=-1.0, high=1.0):
    """Return true states and trials of B noisy open-loop runs with random input steps."""
    system, p, dt = model.system, model.values, noise.dt
    u = np.repeat(rng.uniform(low, high, (T // 10 + 1, B, model.m)), 10, axis=0)[:T]
    x = np.zeros((T + 1, B, model.n))
    delay = round(latency / dt)
    for t in range(T):
        received = u[t - delay] if t >= delay else np.zeros((B, model.m))
        w = noise.process * rng.standard_normal((B, model.n))
        x[t + 1] = system.step(x[t], received, p, dt) + w
    y = x + noise.measurement * rng.standard_normal(x.shape)
    names = (model.state_names, model.input_names)
    return [x[:, b] for b in range(B)], [Trial(y[:, b], u[:, b], dt, *names) for b in range(B)]


def record_of(trial):
    times = np.arange(len(trial.states)) * trial.dt
    past = np.zeros(trial.inputs.shape[1]) if trial.start_inputs is None else trial.start_inputs
    return Record(times, trial.states, times[:-1], trial.inputs, past)


def estimated(model, trials, noise):
    return smoothed(model, [record_of(trial) for trial in trials], noise)


def dense(model, trial, noise):
    """Return mean and covariance of all states given the start sample, and of later samples."""
    system, p, n, T = model.system, model.values, model.n, trial.steps
    Q, R = np.diag(noise.process**2), np.diag(noise.measurement**2)
    A = system.linearise(trial.states[:1], trial.inputs[:1], p, DT)[0][0]
    mean, cov = [trial.states[0]], np.zeros(((T + 1) * n, (T + 1) * n))
    cov[:n, :n] = R
    for t in range(T):
        mean.append(system.step(mean[t][None], trial.inputs[t : t + 1], p, DT)[0])
        here, there = slice(t * n, (t + 1) * n), slice((t + 1) * n, (t + 2) * n)
        cov[there] = A @ cov[here]
        cov[:, there] = cov[there].T
        cov[there, there] = A @ cov[here, here] @ A.T + Q
    return np.concatenate(mean), cov


def test_a_linear_model_is_filtered_and_smoothed_exactly():
    _, trials = simulated(SPRING, np.random.default_rng(0), SPRING_NOISE, B=1, T=30)
    trial, n = trials[0], 2
    mean, cov = dense(SPRING, trial, SPRING_NOISE)
    H = np.eye(len(mean))[n:]
    S = H @ cov @ H.T + np.kron(np.eye(30), np.diag(SPRING_NOISE.measurement**2))
    e = trial.states[1:].ravel() - H @ mean
    loglik = -0.5 * (e @ np.linalg.solve(S, e) + np.linalg.slogdet(2 * np.pi * S)[1])
    after = mean + cov @ H.T @ np.linalg.solve(S, e)

    found = estimated(SPRING, trials, SPRING_NOISE)[0]
    assert found.loglik == pytest.approx(loglik, abs=1e-6)
    assert np.allclose(found.states.ravel(), after, atol=1e-9)


def test_a_state_that_nothing_measures_is_smoothed_halfway_up_its_disturbances():
    """Exactly: (x_t + f(x_t-1)) / 2 of the dense Gaussian."""
    _, trials = simulated(SPRING, np.random.default_rng(0), SPRING_NOISE, B=1, T=30)
    trial, n, noise = trials[0], 2, SPRING_NOISE
    record = record_of(trial)
    seen = np.where([True, False], trial.states, np.nan)
    record = replace(record, measured=seen, start_std=SPRING_NOISE.measurement)
    start = np.array([trial.states[0, 0], 0.0])
    states = np.vstack([start, trial.states[1:]])
    at_start = Trial(states, trial.inputs, DT, SPRING.state_names, SPRING.input_names)
    mean, cov = dense(SPRING, at_start, SPRING_NOISE)
    H = np.eye(len(mean))[n::n]
    S = H @ cov @ H.T + SPRING_NOISE.measurement[0] ** 2 * np.eye(30)
    after = mean + cov @ H.T @ np.linalg.solve(S, states[1:, 0] - H @ mean)
    A = SPRING.system.linearise(states[:1], trial.inputs[:1], SPRING.values, DT)[0][0]
    half, offset = np.eye(len(mean)), np.zeros(len(mean))
    for t in range(1, 31):
        v = n * t + 1
        half[v, v], half[v, v - 3 : v - 1] = 0.5, 0.5 * A[1]
        predicted = SPRING.system.step(np.zeros((1, n)), trial.inputs[t - 1 : t], SPRING.values, DT)
        offset[v] = 0.5 * predicted[0, 1]
    found = smoothed(SPRING, [record], noise)[0]
    assert np.allclose(found.states.ravel(), half @ after + offset, atol=1e-9)


def cut_short(model, trial, steps):
    names = model.state_names, model.input_names
    return Trial(trial.states[: steps + 1], trial.inputs[:steps], DT, *names)


def test_no_other_noise_is_likelier():
    _, trials = simulated(SPRING, np.random.default_rng(2), SPRING_NOISE, B=3, T=60)
    lost = trials[1].states.copy()
    lost[5:8, 0], lost[3] = np.nan, np.nan
    gappy = Trial(lost, trials[1].inputs, DT, SPRING.state_names, SPRING.input_names)
    records = [record_of(one) for one in (trials[0], gappy, cut_short(SPRING, trials[2], 10))]
    found = process_noise(SPRING, records, SPRING_NOISE.measurement)
    best = filtered(SPRING, batch_of(records), found).loglik
    for other in found.process * np.exp([[0.2, 0], [-0.2, 0], [0, 0.2], [0, -0.2], [0.1, -0.1]]):
        noise = replace(found, process=other)
        assert filtered(SPRING, batch_of(records), noise).loglik < best + LAST_GAIN


def test_padding_and_lost_samples_change_nothing_of_the_others():
    _, trials = simulated(SPRING, np.random.default_rng(3), SPRING_NOISE, B=2, T=40)
    some = [trials[0], cut_short(SPRING, trials[1], 20)]
    together = estimated(SPRING, some, SPRING_NOISE)
    for one, trial in zip(together, some, strict=True):
        alone = estimated(SPRING, [trial], SPRING_NOISE)[0]
        assert one.loglik == pytest.approx(alone.loglik)
        assert np.allclose(one.states, alone.states)


def whiteness(found):
    """Return the mean square of all innovations, and the correlation with those a step before."""
    eps = [one.innovations[1:] for one in found]
    lagged = np.concatenate([(e[1:] * e[:-1]).ravel() for e in eps])
    return np.nanmean(np.concatenate(eps) ** 2), np.nanmean(lagged)


def test_the_noise_is_recovered_and_the_filter_is_consistent():
    rng = np.random.default_rng(4)
    truth, trials = simulated(car, rng, CAR_NOISE, B=8, T=150, latency=0.1, low=0.2, high=0.9)
    records, latency = [record_of(trial) for trial in trials], np.array([0.1, 0.1])
    found = process_noise(car, records, CAR_NOISE.measurement, latency=latency)
    assert np.allclose(np.log(found.process / CAR_NOISE.process), 0, atol=0.35)
    square, lagged = whiteness(smoothed(car, records, found, latency=latency))
    assert 0.93 < square < 1.07 and abs(lagged) < 0.05
    after = [one.states for one in smoothed(car, records, found, latency=latency)]
    raw, left = (
        np.sqrt(np.mean([(a - b) ** 2 for a, b in zip(states, truth, strict=True)], axis=(0, 1)))
        for states in ([t.states for t in trials], after)
    )
    assert (left < 0.6 * raw).all()


def test_a_filter_with_the_wrong_noise_has_large_innovations():
    _, trials = simulated(SPRING, np.random.default_rng(12), SPRING_NOISE)
    wrong = NoiseStd(SPRING_NOISE.process / 3, SPRING_NOISE.measurement, DT)
    squares = [whiteness(estimated(SPRING, trials, n))[0] for n in (SPRING_NOISE, wrong)]
    assert squares[0] == pytest.approx(1.0, abs=0.1) and squares[1] > 1.2


@pytest.mark.parametrize("delay", [0.0, 0.4, 1.0, 2.0, 2.3])
def test_received_inputs_are_the_delay_queue_of_the_kernels(delay):
    rng = np.random.default_rng(6)
    u, past = rng.standard_normal((20, 1)), np.array([0.3])
    trial = Trial(np.zeros((21, 2)), u, DT, SPRING.state_names, SPRING.input_names, "", "", past)
    depth = max(1, int(np.ceil(delay)))
    sent = np.concatenate([np.full(depth, past[0]), u[:, 0]])
    queue = np.stack([sent[depth - 1 - i : depth - 1 - i + 20] for i in range(depth)], axis=1)
    expected = queue_of(0, np.array([delay]), (depth,)).effective(queue[: len(u)], u)
    record = record_of(trial)
    assert np.allclose(record.received(np.array([delay * DT])), expected)


def test_angles_wrap_in_innovations():
    _, trials = simulated(car, np.random.default_rng(8), CAR_NOISE, B=1, T=100, low=0.5, high=1.0)
    wrapped = trials[0].states.copy()
    assert np.abs(wrapped[:, 4]).max() > 4
    wrapped[:, 4] = (wrapped[:, 4] + np.pi) % (2 * np.pi) - np.pi
    again = Trial(wrapped, trials[0].inputs, DT, car.state_names, car.input_names)
    a, b = (estimated(car, [t], CAR_NOISE)[0].loglik for t in (trials[0], again))
    assert a == pytest.approx(b)


def test_a_model_that_runs_away_is_a_status():
    explosive = SPRING.with_values({"k": -1e300})
    _, trials = simulated(SPRING, np.random.default_rng(9), SPRING_NOISE, B=1)
    found = estimated(explosive, trials, SPRING_NOISE)[0]
    assert found.loglik == -np.inf
    assert "finite" in found.status


BOOM = Model(
    name="boom",
    states={"th": "rad", "w": "rad/s"},
    inputs={"u": "1"},
    params={"K": Param(0.5, "rad/s", 0.1, 1.0), "tau": Param(0.15, "s", 0.01, 1.0)},
    derivative=lambda s, a, p: {"th": s.w, "w": (p.K * a.u - s.w) / p.tau},
)


def turned():
    """Return the record of a boom's angle at 100 Hz, and its true angle and rate (301,)."""
    t = np.arange(301) * 0.01
    at = t[:-1:4]
    u = np.where((at > 0.25) & (at < 2.2), 0.6 + 0.3 * np.sin(2 * at), 0.0)
    real = BOOM.with_values({"K": 0.4, "tau": 0.06})
    x = stepped(real, np.repeat(u, 4), 0.01)
    y = x[:, :1] + 3e-4 * np.random.default_rng(0).standard_normal((301, 1))
    y = np.hstack([y, np.full_like(y, np.nan)])
    return Record(t, y, at, u[:, None], np.zeros(1), start_std=np.array([1.0, 5.0])), *x.T


@pytest.mark.parametrize(("tau", "rms"), [(0.15, 0.006), (0.054, 0.0085), (0.03, 0.012)])
def test_a_rate_fits_the_slope_of_its_angle_where_the_model_is_off(tau, rms):
    """With a gain 25 % too large, a filter's rate is 0.0013 to 0.0075 rad/s too low on average."""
    record, th, w = turned()
    crude, known, sizes = (
        BOOM.with_values({"tau": tau}),
        np.array([3e-4, 1.0]),
        np.array([1.0, 0.5]),
    )
    noise = process_noise(crude, [record], known, sizes=sizes)
    found = smoothed(crude, [record], noise)[0].states[:, 1]
    assert np.mean(found[1:] + found[:-1]) / 2 == pytest.approx((th[-1] - th[0]) / 3, abs=5e-4)
    assert np.sqrt(np.mean((found - w) ** 2)) < rms
