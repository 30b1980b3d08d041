"""The smoother for stored trials, and what it says about the noise.

Backwards through a filter pass (Bryson and Frazier's form; it inverts no covariance):

    r^-_t = H' S^-1 e_t + (I-KH)' r_t,                  r_{t-1} = A' r^-_t,         r_T = 0
    N^-_t = H' S^-1 H   + (I-KH)' N_t (I-KH),           N_{t-1} = A' N^-_t A
    E[x_t | all] = x^-_t + P^-_t r^-_t,                 Var = P^-_t - P^-_t N^-_t P^-_t

The same r and N are the slopes of the log-likelihood by the variances (Koopman & Shephard 1992):

    d/dQ_t = 1/2 (r^-_{t+1} r^-_{t+1}' - N^-_{t+1}),    d/dR_t = 1/2 (z z' - S^-1 - K' N_t K),
    z = S^-1 e_t - K' r_t
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grounded.estimate.batch import Batch
from grounded.estimate.filtered import Filtered
from grounded.estimate.lanes import backward, unpack
from grounded.frozen import Array


@dataclass(frozen=True, eq=False)
class Smoothed:
    """Arrays time first, as in the batch."""

    x: Array  # (T + 1, B, n)
    P: Array  # (T + 1, B, n, n)
    process_slope: Array  # d loglik / d Q per step, (T, B, n) (diagonal)
    measurement_slope: Array  # d loglik / d R, (T + 1, B, ny) (diagonal), zero where not seen
    start_slope: Array  # d loglik / d P_0, (B, n) (diagonal)


def smooth(filtered: Filtered, batch: Batch) -> Smoothed:
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
