"""Estimate states, and the noise of the process, from records: the functions of this package.

    x_{t+1} = f(x_t, u_t) + w_t,  w ~ N(0, diag(process^2)),     y = x + v,  v ~ N(0, diag(r^2))
    x^-_{t+1} = f(x_t, u_t),      A = f_x(x_t, u_t);             e_t = y_t - x^-_t

of the states that are measured. The extended Kalman filter linearises at each state that it
reaches; the linear equations are those of `grounded.filter.kalman`, which begin with an identity
step before the trial. With r and N of the disturbance smoother (mean and information of what
the data tell of w), the slope of the log-likelihood by a process variance is sum(r^2 - N) / 2. So
at its maximum sum(r^2) = sum(N), and each variance is multiplied by their ratio (the fixed point of
MacKay, "Bayesian interpolation", Neural Computation 4, 1992) while the likelihood rises. A variance
without effect on the data (of a state that is never disturbed) would decrease for ever; it stops at
a floor far below the visible scatter.

Arrays have time first, (T + 1, B, ...): see `grounded.estimate.record`.
Source: Särkkä, Bayesian Filtering and Smoothing (2013), ch. 5; Ljung, System Identification, ch. 7.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.checks import refused, wrong
from grounded.estimate.record import Record, RecordBatch, batch_of
from grounded.filter.kalman import (
    Gains,
    LinearSystem,
    predicted,
    smoother,
    updated,
)
from grounded.frozen import Array, readonly
from grounded.model import Model

FLOOR = 1e-4  # smallest std, as a fraction of the visible scatter
ROUNDS = 30  # most steps towards the likeliest noise
LAST_GAIN = 0.05  # [nats] a step that gains less is the last
TRUSTED = np.log(100.0)  # largest change of a log variance in a step
SHORTEST = 0.05  # smallest fraction of a step that is tried
ROWS = 8_000  # samples; more add little information about the noise


@dataclass(frozen=True, eq=False)
class NoiseStd:
    """Standard deviations of the noise, in the units of the states.

    Args:
        process: process noise w over `dt`, (n,); over a step h it is process * sqrt(h / dt).
        measurement: measurement noise v, (n,); of states that nothing measures it has no part.
        dt: step that `process` refers to [s].

    Raises:
        GroundedError: if a value is negative or not finite, or a measurement noise is zero.
    """

    process: Array
    measurement: Array
    dt: float

    def __post_init__(self) -> None:
        for name in ("process", "measurement"):
            value = readonly(getattr(self, name))
            if value.ndim != 1 or not np.isfinite(value).all() or (value < 0).any():
                raise wrong(f"{name} noise", value, must="weights")
            object.__setattr__(self, name, value)
        if (self.measurement == 0).any():
            raise wrong("measurement noise", self.measurement, must="above")


@dataclass(frozen=True, eq=False)
class Estimated:
    """Estimated states of one record, by the filter or the smoother.

    `innovations` are the filter's in both cases, whitened; NaN where nothing was measured.
    """

    states: Array  # (T + 1, n)
    innovations: Array  # (T + 1, n)
    loglik: float  # log-likelihood of this record's innovations
    status: str


def smoothed(
    model: Model,
    records: Sequence[Record],
    noise: NoiseStd,
    *,
    latency: Array | None = None,
    forward: bool = False,
) -> list[Estimated]:
    """Estimate the states of each record with the smoother, from all of its measurements.

    For a state that nothing measures, the middle of the disturbance at each instant is returned, so
    that a rate is consistent with its integral (`smooth`).

    Args:
        model: n states, m inputs.
        records: at least one, all of one step size.
        noise: process and measurement noise, see `process_noise`.
        latency: transport delay of each input [s], (m,); None for zero.
        forward: use the extended Kalman filter alone, so that each estimate depends only on
            measurements up to its time.
    """
    batch = batch_of(records, latency)
    one = filtered(model, batch, noise)
    x = one.x if forward or not np.isfinite(one.loglik) else smooth(one)
    found = []
    for b, record in enumerate(records):
        rows = slice(0, record.steps + 1)
        seen, eps = batch.seen[rows, b], one.eps[rows, b]
        weight = np.maximum(one.gains.weight[rows, b][seen], 1e-300)
        logs = 2 * np.log(weight) - eps[seen] ** 2 - np.log(2 * np.pi)
        loglik = 0.5 * float(logs.sum()) if np.isfinite(one.loglik) else -np.inf
        found.append(Estimated(x[rows, b], np.where(seen, eps, np.nan), loglik, one.status))
    return found


def process_noise(
    model: Model,
    records: Sequence[Record],
    measurement: Array,
    *,
    latency: Array | None = None,
    sizes: Array | float = 1.0,
) -> NoiseStd:
    """Estimate the process noise of a model on records, by maximum likelihood.

    Errors of the model count as process noise: fit the model first, or use the process noise as a
    measure of its error.

    Args:
        model: n states, m inputs.
        records: at least one with more than two samples.
        measurement: standard deviation of the measurement noise, (n,).
        latency: transport delay of each input [s], (m,); None for zero.
        sizes: typical magnitude of the states that nothing measures, (n,) or one number.

    Raises:
        GroundedError: if no record has more than two samples.
    """
    if max(record.steps for record in records) < 2:
        raise refused("given.short", what="noise", needs=2)
    batch = batch_of(_enough(records), latency)
    visible = first_noise(batch, sizes).process
    noise = NoiseStd(visible, measurement, batch.dt)
    best, part = filtered(model, batch, noise), 1.0
    for _ in range(ROUNDS):
        if not np.isfinite(best.loglik):
            break
        back = smoother(best.gains, best.eps)
        r, N = (np.maximum(a[1:][batch.valid].sum(axis=0), 1e-300) for a in (back.r**2, back.N))
        step = part * np.clip(np.log(r / N), -TRUSTED, TRUSTED)
        process = np.clip(noise.process * np.exp(0.5 * step), FLOOR * visible, 100 * visible)
        trial = NoiseStd(process, measurement, batch.dt)
        after = filtered(model, batch, trial)
        gain = after.loglik - best.loglik
        if gain > 0:
            noise, best, part = trial, after, min(2 * part, 1.0)
        elif (part := part / 4) < SHORTEST:
            break
        if 0 < gain < LAST_GAIN:
            break
    return noise


@dataclass(frozen=True, eq=False)
class Filtered:
    """The result of a pass, arrays with time first; `loglik` is minus infinity if it diverged."""

    x: Array  # (T + 1, B, n) filtered
    x_prior: Array  # (T + 1, B, n) predicted
    e: Array  # (T + 1, B, n) innovations, zero where not seen
    eps: Array  # (T + 1, B, n) the same whitened
    gains: Gains  # of T + 1 steps, the first an identity step; with covariances
    loglik: float
    status: str = "filtered"


def filtered(model: Model, batch: RecordBatch, noise: NoiseStd) -> Filtered:
    """Filter a batch. Divergence does not raise an exception: see `Filtered.status`."""
    (T, B), n = batch.valid.shape, model.n
    A, k, P = (np.zeros((T + 1, B, n, n)) for _ in range(3))
    weight, e, eps, x, x_prior = (np.zeros((T + 1, B, n)) for _ in range(5))
    A[0] = np.eye(n)
    system = _system(batch, noise, A)
    x_prior[0], P[0], status, t = batch.start, system.start[..., None] * np.eye(n), "filtered", 0
    g = Gains(system, k, weight, P)
    with np.errstate(all="ignore"):
        try:
            for t in range(T + 1):
                e[t] = np.where(batch.seen[t], model.difference(batch.y[t], x_prior[t]), 0.0)
                seen = system.seen[t + 1]
                H = seen[..., None] * np.eye(n)
                k[t], W, after = updated(P[t], H, system.R[t + 1], seen)
                weight[t] = np.einsum("bii->bi", W) * seen
                eps[t] = (W @ e[t][..., None])[..., 0]
                x[t] = x_prior[t] + (k[t].swapaxes(1, 2) @ eps[t][..., None])[..., 0]
                if t == T:
                    break
                # a step of the model; records that have ended stay where they are
                step, live = (x[t], batch.u[t], model.values, batch.dt), batch.valid[t][:, None]
                x_prior[t + 1] = np.where(live, model.system.step(*step), x[t])
                slopes = model.system.linearise(*step)[0]
                A[t + 1] = np.where(live[..., None], slopes, np.eye(n))
                if not (np.isfinite(x_prior[t + 1]).all() and np.isfinite(A[t + 1]).all()):
                    raise np.linalg.LinAlgError
                P[t + 1] = predicted(after, A[t + 1], system.Q[t + 1])
        except np.linalg.LinAlgError:
            status = f"the filter diverged to non-finite numbers at step {t + 1}"
    loglik = _likelihood(g, eps, batch) if status == "filtered" else -np.inf
    return Filtered(x, x_prior, e, eps, g, loglik, status)


def smooth(one: Filtered) -> Array:
    """Return the smoothed states (T + 1, B, n) of a finite pass.

    A disturbance acts throughout a step, but the filter adds it at the end of the step. For a state
    that nothing measures this gives a sawtooth: if the model is wrong for some time, each sample is
    off by half a disturbance, which matters when a time constant is close to the step. So the
    middle of the jump is returned for such states, x_t - w_t / 2, with which a rate is consistent
    with its integral (trapezoidal rule).
    """
    g = one.gains
    assert g.P is not None
    back, unseen = smoother(g, one.eps), ~(g.system.seen > 0).any(axis=(0, 1))
    half = np.where(unseen, 0.5 * g.system.Q, 0.0)
    return np.asarray(one.x_prior + (g.P @ back.r[..., None])[..., 0] - half * back.r)


def _system(batch: RecordBatch, noise: NoiseStd, A: Array) -> LinearSystem:
    """Return the linear system with Jacobians A (T + 1, B, n, n), the first an identity step."""
    R, seen = noise.measurement**2, np.zeros((len(A) + 1, *batch.seen.shape[1:]))
    seen[1:] = batch.seen
    Q = np.zeros(A.shape[:-1])
    Q[1:] = np.where(batch.valid, batch.dt / noise.dt, 0.0)[..., None] * noise.process**2
    start = batch.start_var + np.where(batch.sampled, R, 0.0)
    return LinearSystem(A, Q, np.where(seen > 0, R, 1.0), seen, start)


def _likelihood(g: Gains, eps: Array, batch: RecordBatch) -> float:
    """Return the log-likelihood of whitened innovations; minus infinity if it is not finite."""
    total = float(np.sum(eps**2) + g.logdet.sum()) + batch.count * np.log(2 * np.pi)
    return -0.5 * total if np.isfinite(total) else -np.inf


def first_noise(batch: RecordBatch, sizes: Array | float = 1.0) -> NoiseStd:
    """Return a rough estimate of the noise from the smoothness of the measurements, as a start.

    The second differences of a smooth signal are measurement noise (times sqrt 6); the fourth
    (times sqrt 70) also those of a signal that curves. Process noise is taken as a tenth of the
    first differences. `sizes` (n,) are the typical magnitudes of states that nothing measures.
    """
    n = batch.start.shape[1]
    y = np.where(batch.seen, batch.y, np.nan)
    r, q = np.ones(n), 0.05 * np.sqrt(batch.dt) * np.broadcast_to(sizes, n)
    for i in np.flatnonzero(np.isfinite(y).any(axis=(0, 1))):
        one = y[..., i]
        least = max(1e-4 * float(np.nanstd(one)), 1e-9)
        orders = ((2, 6), (4, 70))  # of the difference, and its variance for white noise
        r[i] = max(min(_spread(np.diff(one, n=k, axis=0)) / v**0.5 for k, v in orders), least)
        if np.isfinite(np.diff(one, axis=0)).any():
            q[i] = max(0.1 * _spread(np.diff(one, axis=0)), least)
    return NoiseStd(q, r, batch.dt)


def _enough(records: Sequence[Record]) -> list[Record]:
    """Return all records, or a random selection with about `ROWS` samples."""
    if sum(r.steps for r in records) <= ROWS:
        return list(records)
    order = np.random.default_rng(0).permutation(len(records))
    before = np.cumsum([0, *(records[i].steps for i in order)])[:-1]
    return [records[i] for i, rows in zip(order, before, strict=True) if rows < ROWS]


def _spread(values: Array) -> float:
    """Return a robust standard deviation; the plain one if more than half of the values agree."""
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return 0.0
    mad = 1.4826 * float(np.median(np.abs(finite - np.median(finite))))
    return mad if mad > 0 else float(np.std(finite))
