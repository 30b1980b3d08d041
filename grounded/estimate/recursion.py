"""The filter in NumPy, step by step, what a pass of it leaves behind, and the smoother back.

The reference for the compiled recursions, and the way where nothing can be compiled; notation as in
`grounded.estimate.filter`. The smoother goes backwards through a filter pass (Bryson and Frazier's
form; it inverts no covariance):

    r^-_t = H' S^-1 e_t + (I-KH)' r_t,                  r_{t-1} = A' r^-_t,         r_T = 0
    N^-_t = H' S^-1 H   + (I-KH)' N_t (I-KH),           N_{t-1} = A' N^-_t A
    E[x_t | all] = x^-_t + P^-_t r^-_t,                 Var = P^-_t - P^-_t N^-_t P^-_t

The same r and N are the slopes of the log-likelihood by the variances (Koopman & Shephard 1992):

    d/dQ_t = 1/2 (r^-_{t+1} r^-_{t+1}' - N^-_{t+1}),    d/dR_t = 1/2 (z z' - S^-1 - K' N_t K),
    z = S^-1 e_t - K' r_t
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from grounded.estimate.kernel import Pass, backward, unpack
from grounded.estimate.measurement import Measurement, NoiseStd
from grounded.estimate.record import RecordBatch
from grounded.estimate.steps import Advance
from grounded.frozen import Array


@dataclass(frozen=True, eq=False)
class Filtered:
    """Arrays time first; `loglik` is minus infinity when the pass did not get through."""

    x: Array  # (T + 1, B, n) filtered
    std: Array  # (T + 1, B, n) of x
    x_prior: Array  # (T + 1, B, n) predicted
    P_prior: Array  # (T + 1, B, n, n)
    e: Array  # (T + 1, B, ny) innovations, zero where not seen
    H: Array  # (T + 1, B, ny, n), zero rows where not seen
    R: Array  # (T + 1, B, ny) variance of the measurements, 1 where not seen
    A: Array  # (T, B, n, n)
    f: Array  # (T, B, n) what the model predicted from x
    more: Array  # (T, B, n) variance added to the process noise, see `steps`
    loglik: float
    status: str = "filtered"
    done: Pass | None = field(default=None, repr=False)  # the same in lanes, if it was compiled

    @cached_property
    def C(self) -> Array:
        """Whitening, lower triangular (T + 1, B, ny, ny): C' C = S^-1, identity if not seen."""
        S = self.H @ self.P_prior @ self.H.swapaxes(-1, -2)
        S += self.R[..., None] * np.eye(self.R.shape[-1])
        return np.asarray(np.linalg.inv(np.linalg.cholesky(S)))

    @cached_property
    def K(self) -> Array:
        """Gains (T + 1, B, n, ny)."""
        weight = self.C.swapaxes(-1, -2) @ self.C
        return np.asarray(self.P_prior @ self.H.swapaxes(-1, -2) @ weight)

    @cached_property
    def kept(self) -> Array:
        """I - K H, what an update keeps of the prediction, (T + 1, B, n, n)."""
        return np.asarray(np.eye(self.x.shape[-1]) - self.K @ self.H)

    @cached_property
    def P(self) -> Array:
        """Covariance of the filtered state (T + 1, B, n, n)."""
        spread = (self.K * self.R[..., None, :]) @ self.K.swapaxes(-1, -2)
        return np.asarray(self.kept @ self.P_prior @ self.kept.swapaxes(-1, -2) + spread)

    @cached_property
    def eps(self) -> Array:
        """Whitened innovations (T + 1, B, ny), zero where not seen."""
        return np.asarray((self.C @ self.e[..., None])[..., 0])


def recursion(
    batch: RecordBatch, measurement: Measurement, noise: NoiseStd, advance: Advance
) -> Filtered:
    """One pass over a batch, linearising at each state that it reaches."""
    T, B, n, ny = len(batch.dt), len(batch.lengths), batch.start.shape[1], measurement.ny
    R = noise.measurement**2
    out = _room(T, B, n, ny)
    out["R"] = np.where(batch.seen, R, 1.0)
    x, P = batch.start, _start_covariance(batch, R)
    scale = np.where(batch.valid, batch.dt, 0.0)[..., None, None] * np.diag(
        noise.process**2 / noise.dt
    )
    eye, loglik = np.eye(n), 0.0
    with np.errstate(all="ignore"):
        for t in range(T + 1):
            seen = batch.seen[t]
            e = measurement.innovation(batch.y[t], measurement.function(x))
            e = np.where(seen, e, 0.0)
            H = measurement.jacobian(x) * seen[..., None]
            Ht, Rt = H.transpose(0, 2, 1), out["R"][t][..., None] * np.eye(ny)
            for name, value in (("x_prior", x), ("P_prior", P), ("e", e), ("H", H)):
                out[name][t] = value
            try:
                C = np.linalg.inv(np.linalg.cholesky(H @ P @ Ht + Rt))
            except np.linalg.LinAlgError:
                return _failed(out, t)
            K = P @ Ht @ C.transpose(0, 2, 1) @ C
            kept = eye - K @ H
            x = x + (K @ e[..., None])[..., 0]
            P = kept @ P @ kept.transpose(0, 2, 1) + K @ Rt @ K.transpose(0, 2, 1)
            out["x"][t], out["std"][t] = x, np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
            log_det = np.log(np.diagonal(C, axis1=-2, axis2=-1))[seen]
            loglik += float(log_det.sum() - 0.5 * np.sum((C @ e[..., None]) ** 2))
            if t == T:
                break
            f, A, more = advance(t, x, out["std"][t])
            if not (np.isfinite(f).all() and np.isfinite(A).all()):
                return _failed(out, t + 1)
            out["f"][t], out["A"][t], out["more"][t] = f, A, more
            x, P = f, A @ P @ A.transpose(0, 2, 1) + scale[t] + more[..., None] * eye
    loglik -= 0.5 * np.log(2 * np.pi) * batch.count
    return Filtered(**out, loglik=loglik if np.isfinite(loglik) else -np.inf)


def fixed_steps(filtered: Filtered) -> Advance:
    """The linearisation of an earlier pass, f_t + A_t (x - x_t)."""

    def advance(t: int, x: Array, std: Array) -> tuple[Array, Array, Array]:
        A = filtered.A[t]
        moved = (A @ (x - filtered.x[t])[..., None])[..., 0]
        return filtered.f[t] + moved, A, filtered.more[t]

    return advance


def _room(T: int, B: int, n: int, ny: int) -> dict[str, Any]:
    tails = {"x": (n,), "std": (n,), "x_prior": (n,), "P_prior": (n, n), "e": (ny,), "H": (ny, n)}
    by_step = {"A": (n, n), "f": (n,), "more": (n,)}
    room = {name: np.zeros((T + 1, B, *tail)) for name, tail in tails.items()}
    return room | {name: np.zeros((T, B, *tail)) for name, tail in by_step.items()}


def _start_covariance(batch: RecordBatch, R: Array) -> Array:
    channel = batch.start_channel
    var = batch.start_var + np.where(channel >= 0, R[np.maximum(channel, 0)], 0.0)
    return var[..., None] * np.eye(var.shape[1])


def _failed(out: dict[str, Any], t: int) -> Filtered:
    status = f"the filter left the finite numbers at step {t}"
    return Filtered(**out, loglik=-np.inf, status=status)


@dataclass(frozen=True, eq=False)
class Smoothed:
    """Arrays time first, as in the batch."""

    x: Array  # (T + 1, B, n)
    P: Array  # (T + 1, B, n, n)
    process_slope: Array  # d loglik / d Q per step, (T, B, n) (diagonal)
    measurement_slope: Array  # d loglik / d R, (T + 1, B, ny) (diagonal), zero where not seen
    start_slope: Array  # d loglik / d P_0, (B, n) (diagonal)


def smooth(filtered: Filtered, batch: RecordBatch) -> Smoothed:
    """One pass backwards over a filter pass that got through."""
    B, n = filtered.x.shape[1:]
    if filtered.done is not None:
        back = backward(filtered.done)
        r, N = unpack(back["ry"], B, n), unpack(back["Ny"], B, n, n)
        by_r = unpack(back["r_slope"], B, filtered.R.shape[-1])
    else:
        r, N, by_r = _adjoints(filtered)
    P = filtered.P_prior
    slope = 0.5 * (r**2 - np.diagonal(N, axis1=-2, axis2=-1))
    return Smoothed(
        x=filtered.x_prior + (P @ r[..., None])[..., 0],
        P=P - P @ N @ P,
        process_slope=np.where(batch.valid[..., None], slope[1:], 0.0),
        measurement_slope=np.where(batch.seen, by_r, 0.0),
        start_slope=slope[0],
    )


def _adjoints(filtered: Filtered) -> tuple[Array, Array, Array]:
    """r^- (T + 1, B, n), N^- (T + 1, B, n, n) and the slopes by R (T + 1, B, ny)."""
    T, (B, n) = len(filtered.A), filtered.x.shape[1:]
    weight = filtered.C.swapaxes(-1, -2) @ filtered.C  # S^-1, identity where not seen
    drive = (filtered.C.swapaxes(-1, -2) @ filtered.eps[..., None])[..., 0]  # S^-1 e
    Ht = filtered.H.swapaxes(-1, -2)
    source, source_N = (Ht @ drive[..., None])[..., 0], Ht @ weight @ filtered.H
    r, N = np.zeros((T + 1, B, n)), np.zeros((T + 1, B, n, n))  # r^-, N^-
    after, after_N = np.zeros((T + 1, B, n)), np.zeros((T + 1, B, n, n))  # r_t, N_t
    kept = filtered.kept
    for t in range(T, -1, -1):
        if t < T:
            At = filtered.A[t].transpose(0, 2, 1)
            after[t] = (At @ r[t + 1][..., None])[..., 0]
            after_N[t] = At @ N[t + 1] @ filtered.A[t]
        kt = kept[t].transpose(0, 2, 1)
        r[t] = source[t] + (kt @ after[t][..., None])[..., 0]
        N[t] = source_N[t] + kt @ after_N[t] @ kept[t]
    Kt = filtered.K.swapaxes(-1, -2)
    z = drive - (Kt @ after[..., None])[..., 0]
    spread = weight + Kt @ after_N @ filtered.K
    return r, N, 0.5 * (z**2 - np.diagonal(spread, axis1=-2, axis2=-1))
