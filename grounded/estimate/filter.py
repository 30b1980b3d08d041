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
(`sensitivity`). The linearisation may also be a fixed one, which makes the filter exact for the
model f_t + A_t (x - track_t): the noise is estimated that way.

Notation as above; arrays are time first, (T + 1, B, ...): see `grounded.estimate.batch`.
Source: Särkkä, Bayesian Filtering and Smoothing (2013), ch. 5; Ljung, System Identification, ch. 7.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from grounded.compile import System
from grounded.estimate.batch import Batch
from grounded.estimate.measurement import Measurement
from grounded.estimate.noise import Noise
from grounded.frozen import Array

Advance = Callable[[int, Array], tuple[Array, Array]]  # t, x (B, n) -> f (B, n), A (B, n, n)


@dataclass(frozen=True, eq=False)
class Filtered:
    """Everything one pass leaves behind; `loglik` is minus infinity when it did not get through."""

    x: Array  # (T + 1, B, n) filtered
    P: Array  # (T + 1, B, n, n)
    x_prior: Array  # predicted
    P_prior: Array
    e: Array  # (T + 1, B, ny) innovations, zero where not seen
    C: Array  # (T + 1, B, ny, ny) whitening, lower triangular; identity rows where not seen
    H: Array  # (T + 1, B, ny, n), zero rows where not seen
    K: Array  # (T + 1, B, n, ny)
    A: Array  # (T, B, n, n)
    f: Array  # (T, B, n) what the model predicted from x
    loglik: float
    status: str = "filtered"

    @cached_property
    def eps(self) -> Array:
        """Whitened innovations (T + 1, B, ny), zero where not seen."""
        return np.asarray((self.C @ self.e[..., None])[..., 0])

    @cached_property
    def kept(self) -> Array:
        """I - K H, what an update keeps of the prediction, (T + 1, B, n, n)."""
        return np.asarray(np.eye(self.x.shape[-1]) - self.K @ self.H)


def model_steps(system: System, p: Array, batch: Batch, smoothing: float = 0.0) -> Advance:
    """The model itself, linearised at the filtered state: the extended Kalman filter."""
    sizes = batch.steps_of

    def advance(t: int, x: Array) -> tuple[Array, Array]:
        u = batch.u[t]
        if len(sizes) == 1:
            h = sizes[0][0]
            return system.step(x, u, p, h, smoothing), system.linearise(x, u, p, h, smoothing)[0]
        f, A = x.copy(), np.tile(np.eye(x.shape[1]), (len(x), 1, 1))
        for h, mask in sizes:
            rows = np.flatnonzero(mask[t]) if mask is not None else np.arange(len(x))
            if len(rows):
                f[rows] = system.step(x[rows], u[rows], p, h, smoothing)
                A[rows] = system.linearise(x[rows], u[rows], p, h, smoothing)[0]
        return f, A

    return advance


def fixed_steps(filtered: Filtered) -> Advance:
    """The linearisation of an earlier pass, f_t + A_t (x - x_t)."""

    def advance(t: int, x: Array) -> tuple[Array, Array]:
        A = filtered.A[t]
        return filtered.f[t] + (A @ (x - filtered.x[t])[..., None])[..., 0], A

    return advance


def run(batch: Batch, measurement: Measurement, noise: Noise, advance: Advance) -> Filtered:
    """One pass over a batch. Never raises for numbers that run away: see `Filtered.status`."""
    T, B, n, ny = len(batch.dt), len(batch.lengths), batch.start.shape[1], measurement.ny
    R = noise.measurement**2
    Q = noise.process**2 / noise.dt
    out = _room(T, B, n, ny)
    x, P = batch.start, _start_covariance(batch, R)
    scale, eye = batch.dt[..., None, None] * np.diag(Q), np.eye(n)
    whole = bool(batch.valid.all())
    with np.errstate(all="ignore"):
        for t in range(T + 1):
            out["x_prior"][t], out["P_prior"][t] = x, P
            e, H, Rt = _seen(batch, measurement, R, t, x)
            try:
                C = np.linalg.inv(np.linalg.cholesky(H @ P @ H.transpose(0, 2, 1) + Rt))
            except np.linalg.LinAlgError:
                return _failed(out, t)
            K = P @ H.transpose(0, 2, 1) @ C.transpose(0, 2, 1) @ C
            kept = eye - K @ H
            x = x + (K @ e[..., None])[..., 0]
            P = kept @ P @ kept.transpose(0, 2, 1) + K @ Rt @ K.transpose(0, 2, 1)
            for name, value in (("x", x), ("P", P), ("e", e), ("C", C), ("H", H), ("K", K)):
                out[name][t] = value
            if t == T:
                break
            f, A = advance(t, x)
            if not whole:
                f = np.where(batch.valid[t, :, None], f, x)
                A = np.where(batch.valid[t, :, None, None], A, eye)
            if not (np.isfinite(f).all() and np.isfinite(A).all()):
                return _failed(out, t + 1)
            out["f"][t], out["A"][t] = f, A
            x, P = f, A @ P @ A.transpose(0, 2, 1) + scale[t]
    return _filtered(out, _loglik(batch, out), "filtered")


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


def _start_covariance(batch: Batch, R: Array) -> Array:
    channel = batch.start_channel
    var = batch.start_var + np.where(channel >= 0, R[np.maximum(channel, 0)], 0.0)
    return var[..., None] * np.eye(var.shape[1])


def _seen(
    batch: Batch, measurement: Measurement, R: Array, t: int, x: Array
) -> tuple[Array, Array, Array]:
    """Innovation (B, ny), H (B, ny, n) and R (B, ny, ny); a channel not seen says nothing."""
    e = measurement.innovation(batch.y[t], measurement.function(x))
    H = measurement.jacobian(x)
    if t and batch.whole:
        return e, H, np.broadcast_to(np.diag(R), (len(x), len(R), len(R)))
    seen = batch.seen[t]
    variance = np.where(seen, R, 1.0)
    return np.where(seen, e, 0.0), H * seen[..., None], variance[..., None] * np.eye(len(R))


def _room(T: int, B: int, n: int, ny: int) -> dict[str, Array]:
    tails = {"x": (n,), "P": (n, n), "x_prior": (n,), "P_prior": (n, n), "e": (ny,)}
    tails |= {"C": (ny, ny), "H": (ny, n), "K": (n, ny)}
    room = {name: np.zeros((T + 1, B, *tail)) for name, tail in tails.items()}
    return room | {"A": np.zeros((T, B, n, n)), "f": np.zeros((T, B, n))}


def _loglik(batch: Batch, out: dict[str, Array]) -> float:
    eps = (out["C"] @ out["e"][..., None])[..., 0]
    log_det = np.log(np.diagonal(out["C"], axis1=-2, axis2=-1))  # of S^-1/2; zero where not seen
    value = -0.5 * np.sum(eps**2) + np.sum(log_det[batch.seen])
    value -= 0.5 * np.log(2 * np.pi) * batch.count
    return float(value) if np.isfinite(value) else -np.inf


def _failed(out: dict[str, Array], t: int) -> Filtered:
    return _filtered(out, -np.inf, f"the filter left the finite numbers at step {t}")


def _filtered(out: dict[str, Array], loglik: float, status: str) -> Filtered:
    # Spelt out, so that the type checker sees each field.
    return Filtered(
        x=out["x"],
        P=out["P"],
        x_prior=out["x_prior"],
        P_prior=out["P_prior"],
        e=out["e"],
        C=out["C"],
        H=out["H"],
        K=out["K"],
        A=out["A"],
        f=out["f"],
        loglik=loglik,
        status=status,
    )
