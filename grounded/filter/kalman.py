"""The Kalman filter along many runs at once, and the gradient of its likelihood.

    x_{t+1} = A_t x_t + d_t + G_t w_t,      r_t = H_t x_t + v_t,     Q = var(w), R = var(v) diagonal

Channels are taken one after the other (R is diagonal), so that no matrix is inverted and the
covariance stays symmetric to the last bit, also where A grows without bound:

    P = A P A' + G Q G'                                                         each step
    b = P h',  s = h b + r,  k = b / sqrt(s),  P -= k k'                        each channel

The gains do not depend on the data. They are computed once (`gains`), and any number of columns is
filtered with them (`innovations`): a residual, and how it reacts to whatever may be changed,

    x = A x + d;      eps = (r - h x) / sqrt(s),  x += k eps                    each channel

eps are the WHITENED innovations: independent, of unit variance where model and noise are right
(the same as those of a Cholesky factor of the innovations' covariance). So a fit, and each
candidate of a diagnosis, is a least-squares problem in eps.

`smoother` runs back (de Jong 1989; Koopman & Durbin 2000, "Fast filtering and smoothing for
multivariate state space models"): with u and q its adjoints and D, N their covariances,

    u = (eps - k'q) / sqrt(s),  q += h'u,  N = (1 - K h)' N (1 - K h) + h'h / s   channels back
    d loglik / dR = (u^2 - D) / 2,     d loglik / dQ = (q^2 - N) / 2;     q = A'q,  N = A'N A

and the smoothed state is x + P q, x and P as predicted.

Arrays are time-major: L steps, B runs, N states, n channels, C columns. Row 0 of `r` and `seen` is
the state's start; A, Q lead from row t to row t + 1, where the next measurement is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from grounded.filter import kernels
from grounded.frozen import Array

if TYPE_CHECKING:
    from grounded.filter.augmented import Delayed


class LinearSystem(NamedTuple):
    """What a filter is made of; channel i measures state i."""

    A: Array  # (L, B, N, N)
    Q: Array  # (L, B, N) variances
    R: Array  # (L + 1, B, n) variances; row 0 is not read
    seen: Array  # (L + 1, B, n) 1.0 where a measurement is there; row 0: where r[0] is the start
    start: Array  # (B, N) variances of the state at row 0
    G: Array | None = None  # (L, B, n, n) how the first n disturbances enter; None: as they are


@dataclass(frozen=True, eq=False)
class Gains:
    """What does not depend on the data; zero where a channel was not seen."""

    system: LinearSystem
    k: Array  # (L, B, n, N) each channel's gain, for its whitened innovation
    weight: Array  # (L, B, n) 1 / sqrt(s)
    P: Array | None = None  # (L, B, N, N) covariance of the prediction, where asked for
    delayed: Delayed | None = None  # which measurements are delayed: the system is the widened one

    @property
    def logdet(self) -> Array:
        """Log det of the innovations' covariance over what was seen, (L, B)."""
        seen = self.weight > 0
        return np.asarray(-2 * np.log(self.weight, where=seen, out=np.zeros(seen.shape)).sum(-1))

    @property
    def posterior(self) -> Array:
        """Covariance of the filtered state (L, B, N, N); the gains must hold P."""
        assert self.P is not None
        return np.asarray(self.P - self.k.swapaxes(-1, -2) @ self.k)

    def of_runs(self, which: Any) -> Gains:
        """The same of some runs, by their indices or a slice, in memory of their own."""

        def some(a: Array) -> Array:
            return np.ascontiguousarray(a[:, which])

        late, rows = self.delayed, self.system._asdict()
        start = rows.pop("start")[which]
        rows = {name: None if a is None else some(a) for name, a in rows.items()}
        system = LinearSystem(**rows, start=start)
        if late is not None:
            late = replace(late, channel=late.channel[which], weights=late.weights[which])
        P = None if self.P is None else some(self.P)
        return Gains(system, some(self.k), some(self.weight), P, late)

    def of_steps(self, count: int) -> Gains:
        """The same of the first steps."""
        assert self.delayed is None
        rows = self.system._asdict() | {"seen": self.system.seen[: count + 1]}
        rows |= {name: a[:count] for name, a in rows.items() if name in "AQG" and a is not None}
        rows["R"] = self.system.R[: count + 1]
        return Gains(LinearSystem(**rows), self.k[:count], self.weight[:count])

    @cached_property
    def measured(self) -> Array:
        """H, zero rows where a channel was not seen, (L, B, n, N)."""
        return np.asarray(np.eye(*self.k.shape[2:]) * self.system.seen[1:, ..., None])

    @cached_property
    def whitener(self) -> Array:
        """Whitens all channels of a time at once: lower triangular (L, B, n, n)."""
        low = np.tril(self.measured @ self.k.swapaxes(-1, -2), -1)
        diagonal = np.einsum("...ii->...i", low)
        diagonal[:] = 1 / np.where(self.weight > 0, self.weight, 1.0)
        return np.asarray(np.linalg.inv(low))


def gains(
    system: LinearSystem, delayed: Delayed | None = None, *, covariances: bool = False
) -> Gains:
    """The covariance recursion.

    Args:
        system: the linear system; Q and R may be broadcastable.
        delayed: channels whose measurement is delayed; the system is widened by them.
        covariances: keep those of the predictions.

    Raises:
        numpy.linalg.LinAlgError: when a covariance is not finite.
    """
    if delayed is not None:
        return replace(gains(delayed.system(system), covariances=covariances), delayed=delayed)
    (L, B, N, _), n = system.A.shape, system.seen.shape[-1]
    Q, R = np.broadcast_to(system.Q, (L, B, N)), np.broadcast_to(system.R, (L + 1, B, n))
    system = system._replace(Q=Q, R=R)
    k, weight = np.empty((L, B, n, N)), np.empty((L, B, n))
    P = np.empty((L, B, N, N)) if covariances else None
    if kernels.available(n, N):
        values: dict[str, Any] = {
            "A": system.A,
            "Q": system.Q,
            "start": system.start,
            "G": system.G,
        }
        values |= {"R": system.R[1:], "seen": system.seen[1:]}
        kernels.run("gains", (n, N), values, {"k": k, "weight": weight, "P": P})
        if not np.isfinite(weight).all():
            raise np.linalg.LinAlgError("a covariance is not finite")
        return Gains(system, k, weight, P)
    spread = np.zeros((B, N, N))
    np.einsum("bii->bi", spread)[:] = system.start
    H = Gains(system, k, weight).measured
    for t in range(L):
        spread = predicted(
            spread, system.A[t], system.Q[t], None if system.G is None else system.G[t]
        )
        if P is not None:
            P[t] = spread
        k[t], W, spread = updated(spread, H[t], system.R[t + 1], system.seen[t + 1])
        weight[t] = np.einsum("bii->bi", W) * system.seen[t + 1]
    return Gains(system, k, weight, P)


def predicted(P: Array, A: Array, Q: Array, G: Array | None = None) -> Array:
    """Covariances (B, N, N) a step later: A (B, N, N), variances Q (B, N), entry G (B, n, n)."""
    P = A @ P @ A.swapaxes(1, 2)
    diagonal, m = np.einsum("bii->bi", P), 0
    if G is not None:
        m = G.shape[-1]
        P[:, :m, :m] += (G * Q[:, None, :m]) @ G.swapaxes(1, 2)
    diagonal[:, m:] += Q[:, m:]
    return np.asarray(0.5 * (P + P.swapaxes(1, 2)))


def updated(P: Array, H: Array, R: Array, seen: Array) -> tuple[Array, Array, Array]:
    """The gains k (B, n, N), the whitener (B, n, n), and the covariances (B, N, N) after them.

    Raises:
        numpy.linalg.LinAlgError: when a covariance is not positive.
    """
    S, n = H @ P @ H.swapaxes(1, 2), H.shape[1]
    S[:, np.arange(n), np.arange(n)] += np.where(seen > 0, R, 1.0)
    W = np.linalg.inv(np.linalg.cholesky(S))
    k = W @ H @ P
    gain = k.swapaxes(1, 2) @ W
    left = np.eye(P.shape[-1]) - gain @ H  # Joseph's form: never negative, however vague P was
    known = gain * np.where(seen > 0, R, 0.0)[:, None, :]
    return k, W, left @ P @ left.swapaxes(1, 2) + known @ gain.swapaxes(1, 2)


def innovations(g: Gains, d: Array, r: Array, *, track: bool = False) -> tuple[Array, Array | None]:
    """Filters columns: whitened innovations (L, B, n, C), and the filtered x (L + 1, B, n, C).

    Of the states, the first n are disturbed and returned.

    Args:
        g: the gains.
        d: what each column adds to a step (L, B, n, C).
        r: what each column adds to a measurement (L + 1, B, n, C), or (L + 1, 1, 1, 1) of zeros;
            r[0] is where it begins.
        track: also return the filtered states.
    """
    if g.delayed is None:
        return _innovations(g, d, r, track=track)
    white, filtered = _innovations(g, *g.delayed.columns(d, r), track=track)
    own = np.ascontiguousarray(white[:, :, : d.shape[2]])
    return own, None if filtered is None else g.delayed.errors(filtered)


def _innovations(g: Gains, d: Array, r: Array, *, track: bool) -> tuple[Array, Array | None]:
    (L, B, n, C), N = d.shape, g.k.shape[3]
    compiled = kernels.available(n, N)
    wide = whole(C, n) if compiled else C
    d, r = _widened(d, (L, B, n, wide)), _widened(r, (L + 1, B, n, wide))
    out = np.empty((L, B, n, wide))
    filtered = np.empty((L + 1, B, n, wide)) if track else None
    x = np.zeros((B, N, wide))
    x[:, :n] = r[0] * g.system.seen[0][..., None]
    if filtered is not None:
        filtered[0] = x[:, :n]
    after = None if filtered is None else filtered[1:]
    if compiled:
        values: dict[str, Any] = {"A": g.system.A, "k": g.k, "weight": g.weight}
        values |= {"d": d, "r": r[1:], "x": x}
        kernels.run("innovations", (n, N), values, {"out": out, "track": after})
    else:
        _in_numpy(g, d, r, x, out, after)
    return out[..., :C], None if filtered is None else filtered[..., :C]


def _in_numpy(g: Gains, d: Array, r: Array, x: Array, out: Array, after: Array | None) -> None:
    m, H, W, k = d.shape[2], g.measured, g.whitener, g.k.swapaxes(-1, -2)
    for t in range(len(d)):
        x = g.system.A[t] @ x
        x[:, :m] += d[t]
        out[t] = W[t] @ (r[t + 1] * g.system.seen[t + 1][..., None] - H[t] @ x)
        x = x + k[t] @ out[t]
        if after is not None:
            after[t] = x[:, :m]


def whole(count: int, n: int) -> int:
    """So many columns of n channels that they are filtered without being copied."""
    lanes = kernels.columns_together(n)
    return -(-count // lanes) * lanes


def _widened(columns: Array, shape: tuple[int, ...]) -> Array:
    """With columns of zeros up to a shape."""
    if columns.shape == shape:
        return columns
    found = np.zeros(shape)
    found[..., : columns.shape[-1]] = columns
    return found


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
    (L, B, n, N), G = g.k.shape, g.system.G
    found = Adjoint(
        np.empty((L, B, n)),
        np.empty((L, B, n)),
        np.empty((L, B, N)),
        np.empty((L, B, N)),
    )
    if kernels.available(n, N):
        values: dict[str, Any] = {"A": g.system.A, "G": G, "k": g.k}
        values |= {"weight": g.weight, "white": white}
        kernels.run("smoother", (n, N), values, vars(found))
        return found
    H, W, k = g.measured, g.whitener, g.k.swapaxes(-1, -2)
    q, Nq = np.zeros((B, N, 1)), np.zeros((B, N, N))
    for t in range(L - 1, -1, -1):
        seen, Wt, Ht = g.system.seen[t + 1], W[t].swapaxes(1, 2), H[t].swapaxes(1, 2)
        K = k[t] @ W[t]
        Kt, kept = K.swapaxes(1, 2), np.eye(N) - K @ H[t]
        u = Wt @ white[t][..., None] - Kt @ q
        found.u[t] = u[..., 0] * seen
        found.D[t] = np.einsum("bii->bi", Wt @ W[t] + Kt @ Nq @ K) * seen
        q = q + Ht @ u
        Nq = kept.swapaxes(1, 2) @ Nq @ kept + Ht @ Wt @ W[t] @ H[t]
        found.r[t], found.N[t] = q[..., 0], np.einsum("bii->bi", Nq)
        if G is not None:
            Gt = G[t].swapaxes(1, 2)
            found.r[t, :, :n] = (Gt @ q[:, :n])[..., 0]
            found.N[t, :, :n] = np.einsum("bij,bij->bi", Gt @ Nq[:, :n, :n], Gt)
        At = g.system.A[t].swapaxes(1, 2)
        q, Nq = At @ q, At @ Nq @ g.system.A[t]
        Nq = 0.5 * (Nq + Nq.swapaxes(1, 2))
    return found
