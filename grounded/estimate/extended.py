"""The extended Kalman filter over all trials at once, the smoother, and their likelihood.

    x^-_{t+1} = f(x_t, u_t),      A = f_x(x_t, u_t);      e_t = y_t - H x^-_t

The linear equations are those of `grounded.filter.kalman`.

A pass either runs step by step (`recursion`), linearising at each state that it reaches, or it
iterates to the same result: the model is evaluated along a whole track in one call, the linear
filter runs about that track, and the filtered states are the next track. Sweep s is exact for the
first s steps. In practice two or three sweeps suffice if they start from the track of a similar
fit.

The linear filter begins with an identity step before the trial, so that the first sample is used
like any other. Arrays have time first, (T + 1, B, ...): see `grounded.estimate.record`.
Source: Särkkä, Bayesian Filtering and Smoothing (2013), ch. 5; Ljung, System Identification, ch. 7.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from grounded.estimate.measurement import Measurement, NoiseStd
from grounded.estimate.record import RecordBatch
from grounded.estimate.steps import Advance, ModelSteps
from grounded.filter import kernels
from grounded.filter.kalman import (
    Gains,
    LinearSystem,
    gains,
    innovations,
    predicted,
    smoother,
    updated,
    whole,
)
from grounded.frozen import Array

SWEEPS = 20  # most sweeps
TRACK_SETTLED = 1e-2  # change of the track, in standard deviations, at which sweeps end,
# [nats] or change of the likelihood; at a kink a track may alternate for ever,
LIKELIHOOD_SETTLED = 1e-3
ACCEPTED_AFTER_SWEEPS = 0.05  # [nats] so this change is accepted after SWEEPS


@dataclass(frozen=True, eq=False)
class Track:
    """The estimated states of a pass, from which another pass may start."""

    x: Array  # (T + 1, B, n) filtered
    x_prior: Array  # (T + 1, B, n) predicted


@dataclass(frozen=True, eq=False)
class Filtered(Track):
    """The result of a pass, arrays with time first; `loglik` is minus infinity if it diverged."""

    e: Array  # (T + 1, B, ny) innovations, zero where not seen
    eps: Array  # (T + 1, B, ny) the same whitened
    gains: Gains  # of T + 1 steps, the first an identity step; with covariances
    loglik: float
    status: str = "filtered"

    @property
    def A(self) -> Array:
        """Jacobian of every step (T, B, n, n)."""
        return self.gains.system.A[1:]

    @cached_property
    def columns(self) -> tuple[Array, Array]:
        """Input of the linear filter about this pass, see `_columns`."""
        apart = np.zeros_like(self.x)
        apart[1:] = (self.A @ (self.x_prior - self.x)[:-1, ..., None])[..., 0]
        return _columns(apart, self.e)


def filter_batch(
    batch: RecordBatch,
    measurement: Measurement,
    noise: NoiseStd,
    steps: ModelSteps,
    about: Track | None = None,
) -> Filtered:
    """Filter a batch. Divergence does not raise an exception: see `Filtered.status`.

    Args:
        batch: the records.
        measurement: ny channels.
        noise: process and measurement noise.
        steps: the model.
        about: a pass with nearly the same model and noise, from which sweeps start.
    """
    (T, B), n = batch.dt.shape, batch.start.shape[1]
    if T > 0 and kernels.available(measurement.ny, n):
        if about is not None and about.x.shape == (T + 1, B, n):
            start = about.x[:-1], about.x_prior
        elif measurement.states == tuple(range(n)) and batch.seen[1:].all():
            x = np.concatenate([batch.start[None], batch.y[1:]])
            start = x[:-1], x
        else:
            return recursion(batch, measurement, noise, steps.at)
        found = _sweeps(batch, measurement, noise, steps, *start)
        if found is not None:
            return found
    return recursion(batch, measurement, noise, steps.at)


def _sweeps(
    batch: RecordBatch,
    measurement: Measurement,
    noise: NoiseStd,
    steps: ModelSteps,
    track: Array,
    xbar: Array,
) -> Filtered | None:
    """Iterate to the fixed point from a track (T, B, n) and predictions (T + 1, B, n).

    Returns None if it is not found.
    """
    last = -np.inf
    with np.errstate(all="ignore"):
        for sweep in range(SWEEPS):
            f, A = steps.along(track)
            H, e0 = _seen(batch, measurement, xbar)
            if not all(np.isfinite(array).all() for array in (f, A, H, e0)):
                return None
            direct = measurement.states == tuple(range(track.shape[-1]))
            done = _about(batch, noise, (f, A), (H, e0, direct), track, xbar)
            if done is None:
                return None
            assert done.gains.P is not None
            wide = np.sqrt(np.abs(np.einsum("tbii->tbi", done.gains.P))) + 1e-12
            moved = max(
                float(np.max(np.abs(done.x[:-1] - track) / wide[:-1])),
                float(np.max(np.abs(done.x_prior - xbar) / wide)),
            )
            settled = abs(done.loglik - last) < (
                LIKELIHOOD_SETTLED if sweep < SWEEPS - 1 else ACCEPTED_AFTER_SWEEPS
            )
            if moved < TRACK_SETTLED or settled:
                return done
            track, xbar, last = done.x[:-1], done.x_prior, done.loglik
    return None


def _about(
    batch: RecordBatch,
    noise: NoiseStd,
    step: tuple[Array, Array],
    seen: tuple[Array, Array, bool],
    track: Array,
    xbar: Array,
) -> Filtered | None:
    """Run the linear filter about a track: f + A (x - track), H x.

    `direct`, the last item of `seen`, says whether channel i measures state i. Returns None if the
    result is not finite.
    """
    (f, A), (H, e0, direct) = step, seen
    d = np.empty_like(xbar)
    d[0] = batch.start - xbar[0]
    d[1:] = f + (A @ (xbar[:-1] - track)[..., None])[..., 0] - xbar[1:]
    still = np.broadcast_to(np.eye(A.shape[-1]), A[:1].shape)
    try:
        A = np.concatenate([still, A])
        system = _system(batch, noise, A, None if direct else H)
        g = gains(system, covariances=True)
    except np.linalg.LinAlgError:
        return None
    white, moved = innovations(g, *_columns(d, e0), track=True)
    assert moved is not None
    eps, loglik = white[..., 0], likelihood(g, white[..., 0], batch)
    if not np.isfinite(loglik):
        return None
    x = xbar + moved[1:, ..., 0]
    x_prior = np.empty_like(x)
    x_prior[0], x_prior[1:] = batch.start, f + (A[1:] @ (x[:-1] - track)[..., None])[..., 0]
    e = e0 - (H @ (x_prior - xbar)[..., None])[..., 0]
    return Filtered(x, x_prior, e, eps, g, loglik)


def _system(batch: RecordBatch, noise: NoiseStd, A: Array, H: Array | None) -> LinearSystem:
    """Return the linear system with Jacobians A (T + 1, B, n, n), the first an identity step."""
    R, seen = noise.measurement**2, np.zeros((len(A) + 1, *batch.seen.shape[1:]))
    seen[1:] = batch.seen
    Q = np.zeros(A.shape[:-1])
    Q[1:] = _durations(batch)[..., None] * (noise.process**2 / noise.dt)
    channel = batch.start_channel
    start = batch.start_var + np.where(channel >= 0, R[np.maximum(channel, 0)], 0.0)
    return LinearSystem(A, Q, np.where(seen > 0, R, 1.0), seen, start, H=H)


def _durations(batch: RecordBatch) -> Array:
    """Return the duration of every step (T, B) [s], zero for steps that are not valid."""
    return np.where(batch.valid, batch.dt, 0.0)


def _columns(d: Array, r: Array) -> tuple[Array, Array]:
    """Pad one column, d (T + 1, B, n) and r (T + 1, B, ny), for the linear filter."""
    wide = whole(1, r.shape[-1])
    columns_d, columns_r = np.zeros((*d.shape, wide)), np.zeros((len(r) + 1, *r.shape[1:], wide))
    columns_d[..., 0], columns_r[1:, ..., 0] = d, r
    return columns_d, columns_r


def _seen(batch: RecordBatch, measurement: Measurement, x: Array) -> tuple[Array, Array]:
    """Return H (T + 1, B, ny, n) and y - H x (T + 1, B, ny) on a track, zero where not seen."""
    e = np.where(batch.seen, measurement.innovation(batch.y, x), 0.0)
    return measurement.pick * batch.seen[..., None], e


def likelihood(g: Gains, eps: Array, batch: RecordBatch) -> float:
    """Return the log-likelihood of whitened innovations; minus infinity if it is not finite."""
    total = float(np.sum(eps**2) + g.logdet.sum()) + batch.count * np.log(2 * np.pi)
    return -0.5 * total if np.isfinite(total) else -np.inf


def relinked(about: Filtered, batch: RecordBatch, noise: NoiseStd) -> tuple[Gains, Array, float]:
    """Filter with another noise and the same linearisation.

    Returns:
        The gains, the whitened innovations (T + 1, B, ny) and the log-likelihood.

    Raises:
        numpy.linalg.LinAlgError: if a covariance is not finite.
    """
    system = about.gains.system
    g = gains(_system(batch, noise, system.A, system.H))
    eps = innovations(g, *about.columns)[0][..., 0]
    return g, eps, likelihood(g, eps, batch)


def recursion(
    batch: RecordBatch, measurement: Measurement, noise: NoiseStd, advance: Advance
) -> Filtered:
    """Filter a batch step by step, linearising at each state that is reached."""
    T, B, n, ny = len(batch.dt), len(batch.lengths), batch.start.shape[1], measurement.ny
    A, H = np.zeros((T + 1, B, n, n)), np.zeros((T + 1, B, ny, n))
    A[0] = np.eye(n)
    system = _system(batch, noise, A, H)
    k, weight, P = np.zeros_like(H), np.zeros((T + 1, B, ny)), np.zeros_like(A)
    e, eps, x, x_prior = (np.zeros((T + 1, B, size)) for size in (ny, ny, n, n))
    g, status, t = Gains(system, k, weight, P), "filtered", 0
    x_prior[0], P[0] = batch.start, system.start[..., None] * np.eye(n)
    with np.errstate(all="ignore"):
        try:
            for t in range(T + 1):
                seen = batch.seen[t]
                at = measurement.innovation(batch.y[t], x_prior[t])
                e[t] = np.where(seen, at, 0.0)
                H[t] = measurement.pick * seen[..., None]
                k[t], W, after = updated(P[t], H[t], system.R[t + 1], system.seen[t + 1])
                weight[t] = np.einsum("bii->bi", W) * seen
                eps[t] = (W @ e[t][..., None])[..., 0]
                x[t] = x_prior[t] + (k[t].swapaxes(1, 2) @ eps[t][..., None])[..., 0]
                if t == T:
                    break
                x_prior[t + 1], A[t + 1] = advance(t, x[t])
                if not (np.isfinite(x_prior[t + 1]).all() and np.isfinite(A[t + 1]).all()):
                    raise np.linalg.LinAlgError
                P[t + 1] = predicted(after, A[t + 1], system.Q[t + 1])
        except np.linalg.LinAlgError:
            status = f"the filter diverged to non-finite numbers at step {t + 1}"
        loglik = likelihood(g, eps, batch) if status == "filtered" else -np.inf
    return Filtered(x, x_prior, e, eps, g, loglik, status)


@dataclass(frozen=True, eq=False)
class Smoothed:
    """Smoothed states and covariances, with time first."""

    x: Array  # (T + 1, B, n)
    P: Array  # (T + 1, B, n, n)


def smooth(filtered: Filtered) -> Smoothed:
    """Smooth a finite filter pass by a backward pass.

    A disturbance acts throughout a step, but the filter adds it at the end of the step. For a state
    that no channel measures this gives a sawtooth: if the model is wrong for some time, each sample
    is off by half a disturbance, which matters when a time constant is close to the step. So the
    middle of the jump is returned for such states, x_t - w_t / 2, with which a rate is consistent
    with its integral (trapezoidal rule).
    """
    g, P = filtered.gains, filtered.gains.P
    back = smoother(g, filtered.eps, covariances=True)
    assert P is not None
    assert back.whole is not None
    x, after = filtered.x_prior + (P @ back.r[..., None])[..., 0], P - P @ back.whole @ P
    unseen = np.asarray(~g.measured.any(axis=(0, 1, 2)))
    if unseen.any():
        half, one = np.where(unseen, 0.5 * g.system.Q, 0.0), np.eye(P.shape[-1])
        x -= half * back.r
        both = half[..., None] * (one - back.whole @ P)  # covariance of w_t / 2 and x_t
        own = half[..., None] * (0.5 * one - back.whole * half[..., None, :])  # of w_t / 2
        after -= both + both.swapaxes(-1, -2) - own
    return Smoothed(x, after)


def variance_slopes(g: Gains, eps: Array, batch: RecordBatch, noise: NoiseStd) -> Array:
    """Return the gradient of the log-likelihood by the log variances, (n + ny,)."""
    back = smoother(g, eps)
    state = 0.5 * (back.r**2 - back.N)
    by_q = np.einsum("tbi,tb->i", state[1:], _durations(batch)) / noise.dt
    by_r = 0.5 * (np.einsum("tbi,tbi->i", back.u, back.u) - np.einsum("tbi->i", back.D))
    for c in range(len(by_r)):
        by_r[c] += state[0][batch.start_channel == c].sum()
    return np.concatenate([by_q * noise.process**2, by_r * noise.measurement**2])
