"""The extended Kalman filter along all trials at once, and the likelihood of their innovations.

    predict   x^-_{t+1} = f(x_t, u_t),     P^-_{t+1} = A P_t A' + Q,       A = f_x(x_t, u_t)
    innovate  e_t = y_t - h(x^-_t),        S_t = H P^-_t H' + R,           H = h_x(x^-_t)
    update    x_t = x^-_t + K e_t,         P_t = (I-KH) P^-_t (I-KH)' + K R K'
              K = P^-_t H' S^-1

    log p(y) = -1/2 sum_t ( e_t' S_t^-1 e_t + log det S_t + ny log 2 pi )

`eps = C e`, C'C = S^-1, are the WHITENED innovations: independent, of unit variance, where model
and noise are right. How they react to a change of the model by a small theta is the same
recursion, driven by f_theta (and h_theta):

    D_{t+1} = A ((I-KH) D_t - K h_theta) + f_theta,      d eps_t / d theta = -C (H D_t + h_theta)

so that a fit, and each candidate of the diagnosis, is a least-squares problem in eps
(`sensitivity`).

A pass is either the recursion itself (`recursion.py`) or its fixed point: the model is evaluated
along a whole track in one call, a compiled linear filter runs about that track, and the filtered
states are the next track. Sweep s is exact for the first s steps, and in practice everywhere after
two or three, because a track of a neighbouring fit is at hand.

Notation as above; arrays are time first, (T + 1, B, ...): see `grounded.estimate.record`.
Source: Särkkä, Bayesian Filtering and Smoothing (2013), ch. 5; Ljung, System Identification, ch. 7.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from grounded.estimate import kernel
from grounded.estimate.measurement import Measurement, NoiseStd
from grounded.estimate.record import RecordBatch
from grounded.estimate.recursion import Filtered, recursion
from grounded.estimate.steps import ModelSteps
from grounded.frozen import Array

SWEEPS = 20
CLOSE = 1e-2  # standard deviations: a sweep that moves the track less is the last,
STILL = 1e-3  # [nats] or the likelihood; at a kink a track may flip for ever,
ENOUGH = 0.05  # [nats] and then this is enough after SWEEPS


def filter_batch(
    batch: RecordBatch,
    measurement: Measurement,
    noise: NoiseStd,
    steps: ModelSteps,
    about: Filtered | None = None,
) -> Filtered:
    """One pass over a batch. Never raises for numbers that run away: see `Filtered.status`.

    Args:
        batch: the records.
        measurement: ny channels.
        noise: of process and measurements.
        steps: the model.
        about: a pass with nearly the same model and noise, where sweeps begin.
    """
    (T, B), n = batch.dt.shape, batch.start.shape[1]
    if kernel.usable(T, n, measurement.ny):
        if about is not None and about.x.shape == (T + 1, B, n):
            start = about.x[:-1], about.std[:-1], about.x_prior
        elif measurement.states == tuple(range(n)) and batch.seen[1:].all():
            x = np.concatenate([batch.start[None], batch.y[1:]])
            start = x[:-1], np.broadcast_to(noise.measurement, x[:-1].shape), x
        else:
            first = recursion(batch, measurement, noise, replace(steps, wide=False).at)
            if not steps.wide or not np.isfinite(first.loglik):
                return first
            start = first.x[:-1], first.std[:-1], first.x_prior
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
    std: Array,
    xbar: Array,
) -> Filtered | None:
    """The fixed point, from a track and its std (T, B, n) and predictions (T + 1, B, n).

    None if it is not found.
    """
    (B, n), last = track.shape[1:], -np.inf
    with np.errstate(all="ignore"):
        for sweep in range(SWEEPS):
            f, A, more = steps.along(track, std)
            H, e0 = _seen(batch, measurement, xbar)
            if not all(np.isfinite(array).all() for array in (f, A, H, e0)):
                return None
            lin = kernel.in_lanes(batch, A, f, more, track, H, e0, xbar)
            done = kernel.forward(lin, noise)
            if not np.isfinite(done.loglik):
                return None
            x = kernel.unpack(done.out["x"], B, n)
            x_prior = kernel.unpack(done.out["x_prior"], B, n)
            P = kernel.unpack(done.out["P_prior"], B, n, n)
            wide = np.sqrt(np.abs(np.diagonal(P, axis1=-2, axis2=-1))) + 1e-12
            after = kernel.unpack(kernel.posterior_std(done), B, n)
            moved = max(
                float(np.max(np.abs(x[:-1] - track) / wide[:-1])),
                float(np.max(np.abs(x_prior - xbar) / wide)),
                float(np.max(np.abs(after[:-1] - std) / wide[:-1])) if steps.wide else 0.0,
            )
            settled = abs(done.loglik - last) < (STILL if sweep < SWEEPS - 1 else ENOUGH)
            if moved < CLOSE or settled:
                # f and e are those at the end of the sweep, to first order
                f = f + (A @ (x[:-1] - track)[..., None])[..., 0]
                e = e0 - (H @ (x_prior - xbar)[..., None])[..., 0]
                R = np.where(batch.seen, noise.measurement**2, 1.0)
                return Filtered(
                    x, after, x_prior, P, e, H, R, A, f, more, done.loglik, "filtered", done
                )
            track, std, xbar, last = x[:-1], after[:-1], x_prior, done.loglik
    return None


def _seen(batch: RecordBatch, measurement: Measurement, x: Array) -> tuple[Array, Array]:
    """H (T + 1, B, ny, n) and y - h(x) (T + 1, B, ny) along a track, zero where not seen."""
    flat = x.reshape(-1, x.shape[-1])
    e = measurement.innovation(batch.y, measurement.function(flat).reshape(batch.y.shape))
    H = measurement.jacobian(flat).reshape(*batch.y.shape, x.shape[-1])
    return H * batch.seen[..., None], np.where(batch.seen, e, 0.0)


def sensitivity(filtered: Filtered, f_theta: Array, h_theta: Array | None = None) -> Array:
    """How the whitened innovations react to small changes theta of the model.

    Args:
        filtered: the pass about which to linearise.
        f_theta: change of the next state, (T, B, n, k).
        h_theta: change of the measurement, (T + 1, B, ny, k); None: none.

    Returns:
        d eps / d theta, (T + 1, B, ny, k).
    """
    T, B, n, k = f_theta.shape
    carry = filtered.A @ filtered.kept[:-1]
    drive = f_theta
    if h_theta is not None:
        drive = f_theta - filtered.A @ filtered.K[:-1] @ h_theta[:-1]
    D = np.zeros((T + 1, B, n, k))
    for t in range(T):
        np.matmul(carry[t], D[t], out=D[t + 1])
        D[t + 1] += drive[t]
    seen = filtered.H @ D
    return np.asarray(-filtered.C @ (seen if h_theta is None else seen + h_theta))
