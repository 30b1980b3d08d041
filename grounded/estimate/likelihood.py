"""Estimate process and measurement noise by maximum likelihood of the innovations.

The likelihood is that of `grounded.estimate.extended`; its gradient by the variances comes from one
pass of the smoother. L-BFGS optimises the logarithms of the variances, so that they stay positive.
The linearisation is fixed while the noise is optimised and renewed between rounds, since a track
that was filtered with the wrong noise is a poor linearisation point.

A variance without effect on the data (a sensor without noise, a state that is never disturbed)
would decrease for ever; it stops at a floor far below the visible scatter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.compile import System
from grounded.estimate.extended import Filtered, filter_batch, relinked, variance_slopes
from grounded.estimate.measurement import Measurement, NoiseStd
from grounded.estimate.record import Record, RecordBatch
from grounded.estimate.steps import ModelSteps
from grounded.frozen import Array

FLOOR = 1e-4  # smallest std, as a fraction of the visible scatter
ROUNDS = 4  # most linearisations
LAST_GAIN = 0.2  # [nats] a round that gains less is the last
FIRST_STEPS = 4  # steps of expectation-maximisation
ROWS = 8_000  # samples; more add little information about the noise


@dataclass(frozen=True, eq=False)
class NoiseEstimate:
    """The estimated noise, its log-likelihood, and how the search ended."""

    noise: NoiseStd
    loglik: float
    status: str


def maximum_likelihood(
    system: System,
    p: Array,
    batch: RecordBatch,
    measurement: Measurement,
    start: NoiseStd,
    *,
    rounds: int = ROUNDS,
    held: bool = False,
) -> NoiseEstimate:
    """Search for the most likely noise from `start`.

    Args:
        system: the dynamics (n states).
        p: its parameters (k,).
        batch: the trials.
        measurement: ny channels.
        start: initial noise, see `first_noise`.
        rounds: most linearisations.
        held: whether the measurement noise of `start` is known and kept.
    """
    steps = ModelSteps(system, p, batch)
    noise, best = _expectation(batch, measurement, start, steps, FIRST_STEPS, held)
    status = "converged"
    for round_ in range(rounds):
        if not np.isfinite(best.loglik):
            status = best.status
            break
        trial = _climb(batch, noise, best, start, held)
        after = filter_batch(batch, measurement, trial, steps, best)
        gain = after.loglik - best.loglik
        if gain > 0:
            noise, best = trial, after
        if not gain > LAST_GAIN:
            break
        if round_ == rounds - 1:
            status = "still rising"
    return NoiseEstimate(noise, best.loglik, status)


def _expectation(
    batch: RecordBatch,
    measurement: Measurement,
    noise: NoiseStd,
    steps: ModelSteps,
    rounds: int,
    held: bool,
) -> tuple[NoiseStd, Filtered]:
    """Run expectation-maximisation: each variance becomes its expectation by the smoother.

    It is slow near the optimum, but robust far from it, where it also improves the track.
    """
    best = filter_batch(batch, measurement, noise, steps)
    steps_seen = max(int(batch.valid.sum()), 1)
    samples = np.maximum(batch.seen.sum(axis=(0, 1)), 1)
    for _ in range(rounds):
        if not np.isfinite(best.loglik):
            break
        n = len(noise.process)
        variance = np.concatenate([noise.process, noise.measurement]) ** 2
        slope = variance_slopes(best.gains, best.eps, batch, noise)
        # E[w^2] = q + 2 q (slope by log q) / count
        share = np.concatenate([np.full(n, steps_seen), samples])
        factor = np.clip(1 + 2 * slope / share, 1e-2, 1e2)
        std = np.sqrt(variance * factor)
        trial = NoiseStd(std[:n], noise.measurement if held else std[n:], noise.dt)
        after = filter_batch(batch, measurement, trial, steps, best)
        if not after.loglik > best.loglik:
            break
        noise, best = trial, after
    return noise, best


def first_noise(
    batch: RecordBatch, measurement: Measurement, sizes: Array | float = 1.0
) -> NoiseStd:
    """Return a rough estimate of the noise from the smoothness of the measurements, as a start.

    The second differences of a smooth signal are measurement noise (times sqrt 6); the fourth
    (times sqrt 70) also those of a signal that curves. Process noise is taken as a tenth of the
    first differences. `sizes` (n,) are the typical magnitudes of states that nothing measures.
    """
    n, dt = batch.start.shape[1], round(float(np.median(batch.dt[batch.valid])), 9)
    r, q = np.empty(measurement.ny), 0.05 * np.sqrt(dt) * np.broadcast_to(sizes, n)
    for c, i in enumerate(measurement.states):
        y = np.where(batch.seen[..., c], batch.y[..., c], np.nan)
        one = np.diff(y, axis=0)
        scale = float(np.nanstd(y)) if np.isfinite(y).any() else 1.0
        least = max(1e-4 * scale, 1e-9)
        orders = ((2, 6), (4, 70))  # of the difference, and its variance for white noise
        r[c] = max(min(_spread(np.diff(y, n=k, axis=0)) / v**0.5 for k, v in orders), least)
        if i >= 0 and np.isfinite(one).any():
            q[i] = max(0.1 * _spread(one), least)
    return NoiseStd(q, r, dt)


def enough(records: Sequence[Record], rng: np.random.Generator | None = None) -> list[Record]:
    """Return all records, or a random selection with about `ROWS` samples."""
    total = sum(r.steps for r in records)
    if total <= ROWS:
        return list(records)
    rng = np.random.default_rng(0) if rng is None else rng
    kept: list[Record] = []
    for index in rng.permutation(len(records)):
        kept.append(records[index])
        if sum(r.steps for r in kept) >= ROWS:
            break
    return kept


def _climb(
    batch: RecordBatch, noise: NoiseStd, about: Filtered, start: NoiseStd, held: bool
) -> NoiseStd:
    """Return the most likely noise for a fixed linearisation."""
    from scipy.optimize import minimize

    n, dt = len(noise.process), noise.dt

    def cost(theta: Array) -> tuple[float, Array]:
        std = np.exp(0.5 * theta)
        there = NoiseStd(std[:n], std[n:], dt)
        try:
            g, eps, loglik = relinked(about, batch, there)
        except np.linalg.LinAlgError:
            return 1e12, np.zeros_like(theta)
        if not np.isfinite(loglik):
            return 1e12, np.zeros_like(theta)
        slope = variance_slopes(g, eps, batch, there)
        return -loglik / batch.count, -slope / batch.count

    visible = np.concatenate([start.process, start.measurement])
    theta = 2 * np.log(np.concatenate([noise.process, noise.measurement]))
    low = 2 * np.log(FLOOR * visible)
    high = 2 * np.log(1e4 * visible)
    if held:
        low[n:] = high[n:] = theta[n:]
    bounds = list(zip(low, high, strict=True))
    options = {"maxiter": 60, "ftol": 1e-9, "gtol": 1e-6}
    found = minimize(cost, theta, jac=True, method="L-BFGS-B", bounds=bounds, options=options).x
    std = np.exp(0.5 * found)
    return NoiseStd(std[:n], std[n:], dt)


def _spread(values: Array) -> float:
    """Return a robust standard deviation; the plain one if more than half of the values agree."""
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return 0.0
    mad = 1.4826 * float(np.median(np.abs(finite - np.median(finite))))
    return mad if mad > 0 else float(np.std(finite))
