"""The Kalman filter along many trials at once, and the gradient of its likelihood.

About a track xbar (any), the error e_t = x_t - xbar_t of a trial obeys, to first order,

    e_{t+1} = F_t e_t + d_t + c_t + w_t,     d_t = f(xbar_t, u_t) - xbar_{t+1}
    c_{t+1} = phi c_t + eta_t                              (coloured process noise, optional)
    r_t     = e_t + v_t,                     r_t = y_t - xbar_t

with diagonal Q = var(w), R = var(v). The gains do not depend on the data, so they are computed once
(`gains`) and any number of columns is filtered with them (`innovations`): the residual itself, and
what each candidate effect would add to d_t or r_t. Whitened by the innovations' covariance, each
candidate becomes a small least-squares problem.

`smoother` runs back (de Jong 1989; Koopman & Shephard 1992): with u_t and r_t its adjoints and D_t,
N_t their covariances, d loglik / d R = (u u' - D) / 2 and d loglik / d Q = (r r' - N) / 2.

Where a state is only carried along (a heading rate that is a function of steering and speed), what
disturbs those disturbs it too: the noises enter through G_t (n, n), c + w -> G (c + w).

A delayed measurement (`delayed_measurement`) shows the state of an earlier moment; one more state
each remembers it. Callers see none of that: arrays go in and come out as without.

Arrays are time-major: L steps, B runs, N states of the filter (n, or 2 n with coloured noise), C
columns. A missing measurement is a False in `seen`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from grounded.diagnosis import kernels
from grounded.diagnosis.delayed_measurement import Delayed, FilterSystem
from grounded.frozen import Array

UNKNOWN = 1e6  # standard deviations: how little is known of a state that was not measured at t = 0


@dataclass(frozen=True, eq=False)
class Gains:
    """What does not depend on the data: A (L, B, N, N), K (L, B, N, n), whitener (L, B, n, n).

    Where measurements are delayed, all of them are those of the widened state.
    """

    A: Array
    K: Array
    whiten: Array  # W with W S W' = 1
    logdet: Array  # (L, B) log det S over what was seen
    seen: Array  # (L + 1, B, n) 1.0 or 0.0
    G: Array | None = None  # (L, B, n, n) how noise enters; None: as it is
    delayed: Delayed | None = None  # which measurements are delayed


def transition(F: Array, phi: float | None, G: Array | None = None) -> Array:
    """A of the filter: F alone, or [[F, G], [0, phi]] beside coloured noise."""
    if phi is None:
        return F
    L, B, n, _ = F.shape
    A = np.zeros((L, B, 2 * n, 2 * n))
    A[:, :, :n, :n] = F
    i = np.arange(n)
    if G is None:
        A[:, :, i, n + i] = 1.0
    else:
        A[:, :, :n, n:] = G
    A[:, :, n + i, n + i] = phi
    return A


def gains(
    A: Array,
    Q: Array,
    R: Array,
    seen: Array,
    start: Array,
    G: Array | None = None,
    delayed: Delayed | None = None,
) -> Gains:
    """The covariance recursion.

    Args:
        A: (L, B, N, N).
        Q: variances (L, B, N), or broadcastable to it.
        R: variances (L + 1, B, n), or broadcastable.
        seen: (L + 1, B, n), 1.0 where a measurement is there.
        start: (B, N - n) variance of the coloured noise at t = 0.
        G: (L, B, n, n) how the noise enters, None for the identity.
        delayed: channels whose measurement is delayed.

    Raises:
        numpy.linalg.LinAlgError: when a covariance is not finite.
    """
    L, B, N, _ = A.shape
    Q, R = np.broadcast_to(Q, (L, B, N)), np.broadcast_to(R, (L + 1, B, seen.shape[-1]))
    given = FilterSystem(A, Q, R, seen, start, G)
    if delayed is None:
        return _gains(given)
    return replace(_gains(delayed.system(given)), delayed=delayed)


def _gains(given: FilterSystem) -> Gains:
    A, Q, R, seen, start, G = given
    (L, B, N, _), n = A.shape, seen.shape[-1]
    first = np.concatenate([R[0] * np.where(seen[0] > 0, 1.0, UNKNOWN), start], axis=1)
    if kernels.available(n):
        return _compiled_gains(A, Q, R, seen, first, G)
    K, whiten, logdet = np.empty((L, B, N, n)), np.empty((L, B, n, n)), np.empty((L, B))
    i, k = np.arange(n), np.arange(N)
    P = np.zeros((B, N, N))
    P[:, k, k] = first
    whole = bool(seen.all())
    for t in range(L):
        P = A[t] @ P @ A[t].swapaxes(1, 2)
        if G is None:
            P[:, k, k] += Q[t]
        else:
            P[:, :n, :n] += (G[t] * Q[t][:, None, :n]) @ G[t].swapaxes(1, 2)
            P[:, k[n:], k[n:]] += Q[t][:, n:]
        S, PH = P[:, :n, :n].copy(), P[:, :, :n]
        if whole:
            S[:, i, i] += R[t + 1]
        else:
            mask = seen[t + 1]
            S *= mask[:, :, None] * mask[:, None, :]
            S[:, i, i] += np.where(mask > 0, R[t + 1], 1.0)
            PH = PH * mask[:, None, :]
        chol = np.linalg.cholesky(S)
        W = np.linalg.inv(chol)
        half = PH @ W.swapaxes(1, 2)
        K[t] = half @ W
        P = P - half @ half.swapaxes(1, 2)
        whiten[t] = W
        logdet[t] = 2 * np.log(chol[:, i, i]).sum(axis=1)
    return Gains(A, K, whiten, logdet, seen, G)


def _compiled_gains(
    A: Array, Q: Array, R: Array, seen: Array, first: Array, G: Array | None
) -> Gains:
    L, B, N, _ = A.shape
    n = seen.shape[-1]
    K, whiten = np.empty((L, B, N, n)), np.zeros((L, B, n, n))
    values: dict[str, Any] = {"A": A, "Q": Q, "R": R, "seen": seen, "start": first, "L": L, "B": B}
    values |= {"G": 0 if G is None else G, "K": K, "W": whiten}
    kernels.run_kernel("gains", n, N, G is not None, values)
    diagonal = np.einsum("tbii->tbi", whiten)
    if not np.isfinite(diagonal).all():
        raise np.linalg.LinAlgError("a covariance is not finite")
    return Gains(A, K, whiten, -2 * np.log(diagonal).sum(axis=-1), seen, G)


def innovations(g: Gains, d: Array, r: Array, *, track: bool = False) -> tuple[Array, Array | None]:
    """Filters columns: whitened innovations (L, B, n, C), and the filtered e (L + 1, B, n, C).

    Args:
        g: the gains.
        d: what each column adds to a step (L, B, n, C).
        r: what each column adds to a measurement (L + 1, B, n, C), or (L + 1, 1, 1, 1) of zeros.
        track: also return the filtered errors.
    """
    if g.delayed is None:
        return _innovations(g, d, r, track=track)
    white, filtered = _innovations(g, *g.delayed.columns(d, r), track=track)
    own = np.ascontiguousarray(white[:, :, : d.shape[2]])
    return own, None if filtered is None else g.delayed.errors(filtered)


def _innovations(g: Gains, d: Array, r: Array, *, track: bool) -> tuple[Array, Array | None]:
    L, B, n, C = d.shape
    N = g.A.shape[-1]
    if kernels.available(n):
        return _compiled_innovations(g, d, r, track=track)
    out = np.empty((L, B, n, C))
    filtered = np.empty((L + 1, B, n, C)) if track else None
    M = np.zeros((B, N, C))
    M[:, :n] = r[0] * g.seen[0][:, :, None]
    if filtered is not None:
        filtered[0] = M[:, :n]
    whole = bool(g.seen.all())
    for t in range(L):
        M = g.A[t] @ M
        M[:, :n] += d[t]
        nu = r[t + 1] - M[:, :n]
        if not whole:
            nu = nu * g.seen[t + 1][:, :, None]
        M += g.K[t] @ nu
        out[t] = g.whiten[t] @ nu
        if filtered is not None:
            filtered[t + 1] = M[:, :n]
    return out, filtered


def _compiled_innovations(
    g: Gains, d: Array, r: Array, *, track: bool
) -> tuple[Array, Array | None]:
    L, B, n, C = d.shape
    lanes, wide = kernels.columns_together(n), whole(C, n)
    d, r = _widened(d, (L, B, n, wide)), _widened(r, (L + 1, B, n, wide))
    out = np.empty((L, B, n, wide))
    filtered = np.empty((L + 1, B, n, wide)) if track else None
    values: dict[str, Any] = {"A": g.A, "K": g.K, "W": g.whiten, "d": d, "r": r, "seen": g.seen}
    values |= {"L": L, "B": B, "blocks": wide // lanes, "C": wide, "out": out}
    values |= {"track": 0 if filtered is None else filtered}
    kernels.run_kernel("innovations", n, g.A.shape[-1], g.G is not None, values)
    return out[..., :C], None if filtered is None else filtered[..., :C]


def whole(count: int, n: int) -> int:
    """So many columns that they are filtered without being copied."""
    if not kernels.available(n):
        return count
    return -(-count // kernels.columns_together(n)) * kernels.columns_together(n)


def _widened(columns: Array, shape: tuple[int, ...]) -> Array:
    """With columns of zeros up to a shape."""
    if columns.shape == shape:
        return columns
    whole = np.zeros(shape)
    whole[..., : columns.shape[-1]] = columns
    return whole


@dataclass(frozen=True, eq=False)
class Adjoint:
    """What the likelihood says of each disturbance: u, D (L, B, n) of v; r, N (L, B, N) of w."""

    u: Array
    D: Array
    r: Array
    N: Array

    def parts(self, runs: int) -> list[Adjoint]:
        """Cut along the runs, `runs` to each part."""
        cuts = [slice(i, i + runs) for i in range(0, self.u.shape[1], runs)]
        return [Adjoint(self.u[:, c], self.D[:, c], self.r[:, c], self.N[:, c]) for c in cuts]


def smoother(g: Gains, white: Array) -> Adjoint:
    """The backward pass for one column of whitened innovations, (L, B, n)."""
    if g.delayed is None:
        return _smoother(g, white)
    n, delayed = white.shape[-1], g.delayed
    found = _smoother(g, np.pad(white, [(0, 0), (0, 0), (0, delayed.count)]))
    r, N = delayed.disturbances(found.r, n), delayed.disturbances(found.N, n)
    return Adjoint(found.u[..., :n], found.D[..., :n], r, N)


def _smoother(g: Gains, white: Array) -> Adjoint:
    L, B, N, _ = g.A.shape
    n = white.shape[-1]
    u, D = np.empty((L, B, n)), np.empty((L, B, n))
    r, Nd = np.empty((L, B, N)), np.empty((L, B, N))
    if kernels.available(n):
        values: dict[str, Any] = {"A": g.A, "K": g.K, "W": g.whiten, "white": white}
        values |= {"seen": g.seen, "G": 0 if g.G is None else g.G, "L": L, "B": B}
        values |= {"u": u, "D": D, "r": r, "N": Nd}
        kernels.run_kernel("smoother", n, N, g.G is not None, values)
        return Adjoint(u, D, r, Nd)
    q, Nq = np.zeros((B, N)), np.zeros((B, N, N))
    for t in range(L - 1, -1, -1):
        W, K = g.whiten[t], g.K[t]
        Wt, Kt = W.swapaxes(1, 2), K.swapaxes(1, 2)
        ut = (Wt @ white[t][:, :, None])[:, :, 0] - (Kt @ q[:, :, None])[:, :, 0]
        NK = Nq @ K
        Dt = Wt @ W + Kt @ NK
        seen = g.seen[t + 1]
        u[t], D[t] = ut * seen, np.einsum("bii->bi", Dt) * seen
        q = q.copy()
        q[:, :n] += ut * seen
        Nr = Nq.copy()
        NK = NK * seen[:, None, :]
        Nr[:, :, :n] -= NK
        Nr[:, :n, :] -= NK.swapaxes(1, 2)
        Nr[:, :n, :n] += Dt * seen[:, :, None] * seen[:, None, :]
        r[t], Nd[t] = q, np.einsum("bii->bi", Nr)
        if g.G is not None:
            Gt = g.G[t].swapaxes(1, 2)
            r[t, :, :n] = (Gt @ q[:, :n, None])[:, :, 0]
            Nd[t, :, :n] = np.einsum("bij,bij->bi", Gt @ Nr[:, :n, :n], Gt)
        At = g.A[t].swapaxes(1, 2)
        q = (At @ q[:, :, None])[:, :, 0]
        Nq = At @ Nr @ g.A[t]
        Nq = 0.5 * (Nq + Nq.swapaxes(1, 2))  # what is not symmetric would grow, step by step
    return Adjoint(u, D, r, Nd)
