"""Estimate the states of records, and how much the model is disturbed: smoothed, process_noise.

A `Record` holds measured states and commands of a run, each with its own times:

    y_i = x(t_i) + v_i,          u_j(t) = command_j(t - latency_j)

It may combine a camera at 30 Hz and a controller at 20 Hz: states are estimated at the instants
`times`, and the input over [t_i, t_i+1] is the mean of the held commands over [t_i - latency,
t_i+1 - latency]. On a common grid this equals the delay queue of `grounded.compile.problem`,
including fractions of a step. A lost sample is NaN, and so is a state that nothing measures. A
filter is fast if it runs over all trials at once, so records are combined to a `RecordBatch`, time
first and padded to the longest: padding and lost samples are not `seen`, its steps not `valid`.

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

Source: Särkkä, Bayesian Filtering and Smoothing (2013), ch. 5; Ljung, System Identification, ch. 7.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from grounded.checks import refused
from grounded.filter.kalman import (
    Gains,
    LinearSystem,
    predicted,
    smoother,
    updated,
)
from grounded.frozen import Array
from grounded.model import Model

START_STD = 1.0  # prior standard deviation of an unmeasured first state, in its unit
FLOOR = 1e-4  # smallest std, as a fraction of the visible scatter
ROUNDS = 30  # most steps towards the likeliest noise
LAST_GAIN = 0.05  # [nats] a step that gains less is the last
TRUSTED = np.log(100.0)  # largest change of a log variance in a step
SHORTEST = 0.05  # smallest fraction of a step that is tried
ROWS = 8_000  # samples; more add little information about the noise


@dataclass(frozen=True, eq=False)
class Record:
    """One run with n states and m inputs.

    Args:
        times: instants at which states are estimated, evenly spaced [s], (T + 1,).
        measured: measured states, NaN where nothing was measured, (T + 1, n).
        command_times: times at which commands were sent, ascending [s], (M,).
        commands: commands, each held from its time on, (M, m).
        past: command held before the first one, (m,).
        start: prior mean of the first state, used for states without a measurement, (n,); None for
            zero.
        start_std: prior standard deviation of the first state, (n,); None for 1 in each unit.
    """

    times: Array
    measured: Array
    command_times: Array
    commands: Array
    past: Array
    start: Array | None = None
    start_std: Array | None = None

    @property
    def steps(self) -> int:
        """T, the number of steps."""
        return len(self.times) - 1

    def received(self, latency: Array) -> Array:
        """Return the inputs received over each step, (T, m), with the latency [s] of each (m,)."""
        knots, found = self.command_times, list[Array]()
        for j, late in enumerate(latency):
            # the integral of the command from the first one on, at each instant
            t, values = self.times - late, np.append(self.past[j], self.commands[:, j])
            total = np.append(0.0, np.cumsum(values[1:-1] * np.diff(knots)))
            index = np.searchsorted(knots, t, side="right")
            at = np.maximum(index - 1, 0)
            found.append(total[at] + values[index] * (t - knots[at]))
        return np.diff(np.stack(found, axis=1), axis=0) / np.diff(self.times)[:, None]


def cut(record: Record, seconds: float) -> list[Record]:
    """Cut a record into pieces of about `seconds`, each with its own unknown start state.

    Filters run over many pieces at once, so half an hour takes little longer than a minute.
    """
    span = record.times[-1] - record.times[0]
    pieces = max(1, round(span / seconds))
    edges = np.linspace(0, record.steps, pieces + 1).round().astype(int)
    return [part(record, int(a), int(b)) for a, b in pairwise(edges)]


def part(record: Record, first: int, last: int) -> Record:
    """Return rows first .. last of a record with all commands (latency needs earlier ones)."""
    rows = slice(first, last + 1)
    return replace(record, times=record.times[rows], measured=record.measured[rows])


@dataclass(frozen=True, eq=False)
class RecordBatch:
    """B records of at most T steps of dt; n states, m inputs."""

    dt: float  # [s]
    y: Array  # (T + 1, B, n), zero where not seen
    seen: Any  # (T + 1, B, n) of bool
    u: Array  # (T, B, m) inputs as received
    valid: Any  # (T, B) of bool
    start: Array  # (B, n) mean of the first state
    start_var: Array  # (B, n) its variance, without the measurement noise
    sampled: Any  # (B, n) of bool: the start is a sample, and has its noise

    @property
    def count(self) -> int:
        """Number of samples in the likelihood."""
        return int(self.seen.sum())


def batch_of(records: Sequence[Record], latency: Array | None = None) -> RecordBatch:
    """Combine records of one step size to a batch.

    A measured state starts at its first sample, with that sample's noise; the sample is then not
    used a second time. If it was measured only later, it may have changed by as much as it varies.

    Args:
        records: at least one record.
        latency: latency of each input [s], (m,); None for zero.
    """
    (_, n), m, B = records[0].measured.shape, records[0].commands.shape[1], len(records)
    T, late = max(r.steps for r in records), np.zeros(m) if latency is None else latency
    y, u = np.full((T + 1, B, n), np.nan), np.zeros((T, B, m))
    start, var, sampled = np.zeros((B, n)), np.empty((B, n)), np.zeros((B, n), dtype=bool)
    for b, record in enumerate(records):
        y[: record.steps + 1, b], u[: record.steps, b] = record.measured, record.received(late)
        start[b] = 0.0 if record.start is None else record.start
        var[b] = np.square(START_STD if record.start_std is None else record.start_std)
        for i in range(n):
            known_at = np.flatnonzero(np.isfinite(record.measured[:, i]))
            if len(known_at):
                start[b, i], sampled[b, i] = record.measured[known_at[0], i], known_at[0] == 0
                spread = max(float(np.var(record.measured[known_at, i])), 1e-12)
                var[b, i] = 0.0 if sampled[b, i] else spread
    seen = np.isfinite(y)
    seen[0] = False
    valid = np.arange(T)[:, None] < np.array([r.steps for r in records])
    dt = round(float(records[0].times[1] - records[0].times[0]), 9) if T else 1.0
    return RecordBatch(dt, np.where(seen, y, 0.0), seen, u, valid, start, var, sampled)


@dataclass(frozen=True, eq=False)
class NoiseStd:
    """Standard deviations of the noise, in the units of the states.

    Args:
        process: process noise w over `dt`, (n,); over a step h it is process * sqrt(h / dt).
        measurement: measurement noise v, (n,); of states that nothing measures it has no part.
        dt: step that `process` refers to [s].
    """

    process: Array
    measurement: Array
    dt: float


@dataclass(frozen=True, eq=False)
class Estimated:
    """Smoothed states of one record.

    `innovations` are the filter's, whitened; NaN where nothing was measured.
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
) -> list[Estimated]:
    """Estimate the states of each record with the smoother, from all of its measurements.

    For a state that nothing measures, the middle of the disturbance at each instant is returned, so
    that a rate is consistent with its integral (`smooth`).

    Args:
        model: n states, m inputs.
        records: at least one, all of one step size.
        noise: process and measurement noise, see `process_noise`.
        latency: transport delay of each input [s], (m,); None for zero.
    """
    batch = batch_of(records, latency)
    one = filtered(model, batch, noise)
    x = smooth(one) if np.isfinite(one.loglik) else one.x
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
    visible = first_process(batch, sizes)
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
    eps: Array  # (T + 1, B, n) innovations whitened, zero where not seen
    gains: Gains  # of T + 1 steps, the first an identity step; with covariances
    loglik: float
    status: str = "filtered"


def filtered(model: Model, batch: RecordBatch, noise: NoiseStd) -> Filtered:
    """Filter a batch. Divergence does not raise an exception: see `Filtered.status`."""
    (T, B), n = batch.valid.shape, model.n
    A, k, P = (np.zeros((T + 1, B, n, n)) for _ in range(3))
    weight, eps, x, x_prior = (np.zeros((T + 1, B, n)) for _ in range(4))
    A[0] = np.eye(n)
    system = _system(batch, noise, A)
    x_prior[0], P[0], status, t = batch.start, system.start[..., None] * np.eye(n), "filtered", 0
    g = Gains(system, k, weight, P)
    with np.errstate(all="ignore"):
        try:
            for t in range(T + 1):
                e = np.where(batch.seen[t], model.difference(batch.y[t], x_prior[t]), 0.0)
                seen = system.seen[t + 1]
                H = seen[..., None] * np.eye(n)
                k[t], W, after = updated(P[t], H, system.R[t + 1], seen)
                weight[t] = np.einsum("bii->bi", W) * seen
                eps[t] = (W @ e[..., None])[..., 0]
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
        total = float(np.sum(eps**2) + g.logdet.sum()) + batch.count * np.log(2 * np.pi)
    loglik = -0.5 * total if status == "filtered" and np.isfinite(total) else -np.inf
    return Filtered(x, x_prior, eps, g, loglik, status)


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


def first_process(batch: RecordBatch, sizes: Array | float = 1.0) -> Array:
    """Return a rough process noise, (n,), a tenth of the first differences, as a start.

    `sizes` (n,) are the typical magnitudes of states that nothing measures.
    """
    n = batch.start.shape[1]
    y = np.where(batch.seen, batch.y, np.nan)
    q = 0.05 * np.sqrt(batch.dt) * np.broadcast_to(sizes, n)
    for i in np.flatnonzero(np.isfinite(np.diff(y, axis=0)).any(axis=(0, 1))):
        least = max(1e-4 * float(np.nanstd(y[..., i])), 1e-9)
        q[i] = max(0.1 * _spread(np.diff(y[..., i], axis=0)), least)
    return np.asarray(q)


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
