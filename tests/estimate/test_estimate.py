"""Compares the filter with a dense Gaussian, slopes with differences, intervals with truth."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from consistency import consistency
from facts import holding
from grounded.compile.problem import queue_of
from grounded.errors import GroundedError
from grounded.estimate import (
    NoiseStd,
    noise_of,
    record_of,
    smooth_trials,
)
from grounded.estimate.record import batch_of
from grounded.estimate.smoother import filtered, relinked, variance_slopes
from grounded.model import Model, Param
from grounded.models.car import model as car
from grounded.trial import Trial

DT = 0.05
filter_trials = partial(smooth_trials, forward=True)


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
    gain = cov @ H.T @ np.linalg.inv(S)
    after, spread = mean + gain @ e, cov - gain @ H @ cov

    smoothed = smooth_trials(SPRING, trials, SPRING_NOISE)[0]
    assert smoothed.loglik == pytest.approx(loglik, abs=1e-6)
    assert np.allclose(smoothed.states.ravel(), after, atol=1e-9)
    assert np.allclose(smoothed.std.ravel() ** 2, np.diag(spread), rtol=1e-5, atol=1e-12)
    filtered = filter_trials(SPRING, trials, SPRING_NOISE)[0]
    assert filtered.loglik == pytest.approx(loglik, abs=1e-6)
    assert np.allclose(filtered.states[-1], smoothed.states[-1])


def test_a_state_that_nothing_measures_is_smoothed_halfway_up_its_disturbances():
    """Exactly, with its covariance: (x_t + f(x_t-1)) / 2 of the dense Gaussian."""
    _, trials = simulated(SPRING, np.random.default_rng(0), SPRING_NOISE, B=1, T=30)
    trial, n, noise = trials[0], 2, SPRING_NOISE
    record = record_of(SPRING, trial)
    seen = np.where([True, False], trial.states, np.nan)
    record = replace(record, measured=seen, start_std=SPRING_NOISE.measurement)
    start = np.array([trial.states[0, 0], 0.0])
    states = np.vstack([start, trial.states[1:]])
    at_start = Trial(states, trial.inputs, DT, SPRING.state_names, SPRING.input_names)
    mean, cov = dense(SPRING, at_start, SPRING_NOISE)
    H = np.eye(len(mean))[n::n]
    S = H @ cov @ H.T + SPRING_NOISE.measurement[0] ** 2 * np.eye(30)
    gain = cov @ H.T @ np.linalg.inv(S)
    after, spread = mean + gain @ (states[1:, 0] - H @ mean), cov - gain @ H @ cov
    A = SPRING.system.linearise(states[:1], trial.inputs[:1], SPRING.values, DT)[0][0]
    half, offset = np.eye(len(mean)), np.zeros(len(mean))
    for t in range(1, 31):
        v = n * t + 1
        half[v, v], half[v, v - 3 : v - 1] = 0.5, 0.5 * A[1]
        predicted = SPRING.system.step(np.zeros((1, n)), trial.inputs[t - 1 : t], SPRING.values, DT)
        offset[v] = 0.5 * predicted[0, 1]

    found = smooth_trials(SPRING, [record], noise)[0]
    assert np.allclose(found.states.ravel(), half @ after + offset, atol=1e-9)
    blocks = (half @ spread @ half.T).reshape(31, n, 31, n)
    expected = blocks[np.arange(31), :, np.arange(31)]
    assert np.allclose(found.covariance, expected, rtol=1e-5, atol=1e-12)


CAR_NOISE = NoiseStd(
    np.array([0.003, 0.01, 0.001, 0.001, 0.002, 0.02]),
    np.array([0.01, 0.03, 0.003, 0.003, 0.01, 0.05]),
    DT,
)


def test_slopes_by_the_variances_match_differences():
    _, trials = simulated(SPRING, np.random.default_rng(2), SPRING_NOISE, B=3, T=25)
    short = Trial(
        trials[2].states[:11], trials[2].inputs[:10], DT, SPRING.state_names, SPRING.input_names
    )
    lost = trials[1].states.copy()
    lost[5:8, 0], lost[3] = np.nan, np.nan
    gappy = Trial(lost, trials[1].inputs, DT, SPRING.state_names, SPRING.input_names)
    batch = batch_of([record_of(SPRING, one) for one in (trials[0], gappy, short)])
    base = filtered(SPRING, batch, SPRING_NOISE)
    assert relinked(base, batch, SPRING_NOISE)[-1] == pytest.approx(base.loglik)

    def at(theta):
        std = np.exp(theta / 2)
        noise = NoiseStd(std[:2], std[2:], DT)
        return noise, *relinked(base, batch, noise)

    theta = 2 * np.log(np.concatenate([SPRING_NOISE.process, SPRING_NOISE.measurement]))
    noise, gains, eps, _ = at(theta)
    slope = variance_slopes(gains, eps, batch, noise)
    for i in range(4):
        step = 1e-4 * np.eye(4)[i]
        assert slope[i] == pytest.approx(
            (at(theta + step)[-1] - at(theta - step)[-1]) / 2e-4, rel=1e-5
        )


def test_padding_and_lost_samples_change_nothing_of_the_others():
    _, trials = simulated(SPRING, np.random.default_rng(3), SPRING_NOISE, B=2, T=40)
    short = Trial(
        trials[1].states[:21], trials[1].inputs[:20], DT, SPRING.state_names, SPRING.input_names
    )
    together = filter_trials(SPRING, [trials[0], short], SPRING_NOISE)
    for one, trial in zip(together, [trials[0], short], strict=True):
        alone = filter_trials(SPRING, [trial], SPRING_NOISE)[0]
        assert one.loglik == pytest.approx(alone.loglik)
        assert np.allclose(one.states, alone.states)
        assert np.allclose(one.covariance, alone.covariance)


def test_the_noise_is_recovered_and_the_filter_is_consistent():
    rng = np.random.default_rng(4)
    truth, trials = simulated(car, rng, CAR_NOISE, B=8, T=150, latency=0.1, low=0.2, high=0.9)
    latency = np.array([0.1, 0.1])
    found = noise_of(car, trials, latency=latency)
    assert found.status == "converged"
    assert np.allclose(np.log(found.noise.process / CAR_NOISE.process), 0, atol=0.35)
    assert np.allclose(np.log(found.noise.measurement / CAR_NOISE.measurement), 0, atol=0.15)
    filtered = filter_trials(car, trials, found.noise, latency=latency)
    verdict = consistency(filtered, truth)
    assert 0.93 < verdict.nis < 1.07
    assert abs(verdict.lag_one) < 0.05
    assert 0.85 < verdict.nees < 1.15
    smoothed = smooth_trials(car, trials, found.noise, latency=latency)
    raw, after = (
        np.sqrt(np.mean([(a - b) ** 2 for a, b in zip(states, truth, strict=True)], axis=(0, 1)))
        for states in ([t.states for t in trials], [s.states for s in smoothed])
    )
    assert (after < 0.6 * raw).all()


def test_a_filter_with_the_wrong_noise_is_called_inconsistent():
    truth, trials = simulated(SPRING, np.random.default_rng(12), SPRING_NOISE)
    wrong = NoiseStd(SPRING_NOISE.process / 3, SPRING_NOISE.measurement, DT)
    assert not consistency(filter_trials(SPRING, trials, wrong), truth).consistent
    assert consistency(filter_trials(SPRING, trials, SPRING_NOISE), truth).consistent


@pytest.mark.parametrize("delay", [0.0, 0.4, 1.0, 2.0, 2.3])
def test_received_inputs_are_the_delay_queue_of_the_kernels(delay):
    rng = np.random.default_rng(6)
    u, past = rng.standard_normal((20, 1)), np.array([0.3])
    trial = Trial(np.zeros((21, 2)), u, DT, SPRING.state_names, SPRING.input_names, "", "", past)
    depth = max(1, int(np.ceil(delay)))
    sent = np.concatenate([np.full(depth, past[0]), u[:, 0]])
    queue = np.stack([sent[depth - 1 - i : depth - 1 - i + 20] for i in range(depth)], axis=1)
    expected = queue_of(0, np.array([delay]), (depth,)).effective(queue[: len(u)], u)
    record = record_of(SPRING, trial)
    assert np.allclose(record.received(np.array([delay * DT])), expected)


def test_angles_wrap_in_innovations():
    _, trials = simulated(car, np.random.default_rng(8), CAR_NOISE, B=1, T=100, low=0.5, high=1.0)
    wrapped = trials[0].states.copy()
    assert np.abs(wrapped[:, 4]).max() > 4
    wrapped[:, 4] = (wrapped[:, 4] + np.pi) % (2 * np.pi) - np.pi
    again = Trial(wrapped, trials[0].inputs, DT, car.state_names, car.input_names)
    a, b = (filter_trials(car, [t], CAR_NOISE)[0].loglik for t in (trials[0], again))
    assert a == pytest.approx(b)


def test_a_model_that_runs_away_is_a_status():
    explosive = SPRING.with_values({"k": -1e300})
    _, trials = simulated(SPRING, np.random.default_rng(9), SPRING_NOISE, B=1)
    found = filter_trials(explosive, trials, SPRING_NOISE)[0]
    assert found.loglik == -np.inf
    assert "finite" in found.status


def test_misuse_says_what_to_do():
    _, trials = simulated(SPRING, np.random.default_rng(11), SPRING_NOISE, B=1)
    with pytest.raises(GroundedError, match=holding("process noise", "(2,)", "(3,)")):
        filter_trials(SPRING, trials, NoiseStd(np.ones(3), np.ones(2), DT))
    with pytest.raises(GroundedError, match=r"\bingest\b"):
        filter_trials(SPRING, [], SPRING_NOISE)
    with pytest.raises(GroundedError, match=holding("'steering'")):
        filter_trials(car, trials, CAR_NOISE)
    with pytest.raises(GroundedError, match="finite"):
        NoiseStd(np.array([np.nan]), np.ones(1), DT)
