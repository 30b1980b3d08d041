"""Maximum likelihood of the variances of process and measurement noise.

Process noise w (variance Q) and measurement noise v (variance R) are diagonal, one variance per
channel. Two departures from white Gaussian noise are allowed before an effect is claimed:

    coloured   in addition to w, a disturbance c_{t+1} = phi c_t + eta with phi = exp(-dt / tau): a
               gust, a carpet, a swaying antenna (variance C of c, one per channel)
    heavy      v and w are Student-t with 4 degrees of freedom: each sample is normal with its own
               precision, weighted by its expectation (dof + 1) / (dof + E[v^2] / R). The weights
               are found for one fit (`cleaned`) and kept with the data. All hypotheses are compared
               with the same weights, so that outliers count for little and favour none of them.

Variances are fitted by scoring: with the smoother's adjoint r and its covariance N,
d loglik / d log q = q sum(r^2 - N) / 2. The variances are coupled, since noise of an encoder can be
mistaken for a disturbance of the speed behind it. So all of them step together, with the average of
the observed and the expected information as the curvature (Gilmour, Thompson & Cullis 1995,
"Average information REML"). With P the inverse covariance of the data and V_i its derivative by
variance i,

    AI_ij = 1/2 (V_i P y)' P (V_j P y)

The smoother gives P y per disturbance, so V_i P y is the response of the system to the disturbance
variance_i * adjoint_i, which is one more column for the filter. The matrix is never indefinite, and
one pass of the filter gives it for all variances.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from grounded.filter import kalman
from grounded.filter.kalman import Adjoint
from grounded.frozen import Array

DOF = 4.0
UNSEEN = 1e-2  # initial disturbance of a state that is never measured, as a fraction of its scale
REMEMBERED = 20  # steps after which a start is taken to be forgotten
# fraction of a channel's one-step variance below which a variance counts as zero
ZERO_VARIANCE = 1e-4


@dataclass(frozen=True)
class Structure:
    """Noise allowed in addition to white noise: tau [s] of a coloured part, or None."""

    tau: float | None = None

    def phi(self, dt: float) -> float | None:
        """Return the correlation of the coloured part over one step, None without one."""
        return None if self.tau is None else math.exp(-dt / self.tau)

    def numbers(self, n: int) -> int:
        """Return the effective number of parameters in addition to those of white noise.

        Two are counted, a correlation time and one variance, because the coloured part is zero in
        most channels. Counting all n + 1 would make an effect cheaper than coloured noise.
        """
        return 0 if self.tau is None else 2


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Log variances (n,) of w, v and c, and outlier weights (L, B, n) or 1.0."""

    structure: Structure
    log_q: Array
    log_r: Array
    log_c: Array
    floor: Array  # (n,) log variance below which nothing is resolved
    weight_w: Array | float = 1.0
    weight_v: Array | float = 1.0

    @property
    def logs(self) -> tuple[Array, Array, Array]:
        """All log variances: of w, of v, of the coloured part."""
        return self.log_q, self.log_r, self.log_c

    def process(self, dt: float) -> Array:
        """Return Q for the filter, (L, B, N) or (N,)."""
        q = np.asarray(np.exp(self.log_q) / self.weight_w)
        phi = self.structure.phi(dt)
        if phi is None:
            return q
        eta = np.exp(self.log_c) * (1 - phi**2)
        return np.concatenate([q, np.broadcast_to(eta, q.shape)], axis=-1)

    def measurement(self, steps: int) -> Array:
        """Return R for the filter, (L + 1, 1 or B, n)."""
        r = np.exp(self.log_r) / self.weight_v
        if r.ndim == 1:
            return np.broadcast_to(r, (steps + 1, 1, len(r)))
        return np.concatenate([np.broadcast_to(np.exp(self.log_r), r[:1].shape), r])

    @property
    def plain(self) -> NoiseModel:
        """The same noise without weights, its variances those of w and v including outliers."""
        if isinstance(self.weight_w, float) or isinstance(self.weight_v, float):
            return self
        w, v = ((DOF + 1) / weight - DOF for weight in (self.weight_w, self.weight_v))
        log_q, log_r = (
            log + np.log(np.maximum(size.mean(axis=(0, 1)), 1e-12))
            for log, size in ((self.log_q, w), (self.log_r, v))
        )
        return replace(self, log_q=log_q, log_r=log_r, weight_w=1.0, weight_v=1.0)

    def start(self, runs: int) -> Array:
        """Return the variance of the coloured part at t = 0, (B, 0 or n)."""
        if self.structure.tau is None:
            return np.zeros((runs, 0))
        return np.tile(np.exp(self.log_c), (runs, 1))

    def behind(self, now: Mapping[int, int]) -> NoiseModel:
        """Move the process noise of delayed logs to their current true values, {log: true}.

        A delayed log is just an old true value, so an apparent disturbance of it disturbed the true
        value earlier. Without process noise the log would never correct the true value.
        """
        if not now:
            return self
        log_q, floor = self.log_q.copy(), self.floor.copy()
        for log, true in now.items():
            log_q[true], floor[true], log_q[log] = log_q[log], floor[log], floor[log]
        return replace(self, log_q=log_q, log_c=log_q.copy(), floor=floor)

    def allowing(self, structure: Structure, dt: float) -> NoiseModel:
        """Return where a fit of the same noise with another structure starts."""
        if structure.tau is None or self.structure.tau is not None:
            return replace(self, structure=structure)
        # a tenth of the low-frequency power: summed over time, c has about 2 tau / dt times its C
        share = math.log(0.1 * dt / (2 * structure.tau))
        log_c = np.maximum(self.log_q + share, self.floor)
        return replace(self, structure=structure, log_c=log_c)

    def towards(self, other: NoiseModel, part: float) -> NoiseModel:
        """Return the noise a fraction `part` of the way to another of the same structure."""
        if part == 1.0 or other is self:
            return other
        logs = {
            name: getattr(self, name) + part * (getattr(other, name) - getattr(self, name))
            for name in ("log_q", "log_r", "log_c")
        }
        return replace(self, **logs)


def noise_guess(residual: Array, seen: Array, scale: Array) -> NoiseModel:
    """Return initial variances from one-step residuals of the raw measurements, (L, B, n).

    A residual has a variance of about q + 2 r and a lag-one covariance of -r. Medians make the
    estimate robust.
    """
    n = residual.shape[-1]
    floor = 2 * np.log(1e-6 * scale + 1e-300)
    log_q, log_r = np.empty(n), np.empty(n)
    for i in range(n):
        good = (seen[1:, :, i] > 0) & (seen[:-1, :, i] > 0)
        steps = bool(good.any())  # else the residuals are those of held samples, not of steps
        good = good if steps else seen[1:, :, i] > 0
        e = residual[:, :, i]
        values = e[good]
        spread = 1.4826 * np.median(np.abs(values - np.median(values))) if values.size else 0.0
        total = max(spread**2, 1e-4 * float(np.var(values)) if values.size else 0.0, 1e-30)
        clipped = np.clip(e, -5 * spread - 1e-30, 5 * spread + 1e-30)
        both = good[1:] & good[:-1]
        lagged = float(np.mean((clipped[1:] * clipped[:-1])[both])) if both.any() else 0.0
        r = min(max(-lagged, 0.02 * total), 0.45 * total)
        log_r[i], log_q[i] = math.log(r), math.log(max(total - 2 * r, 0.05 * total))
        if not values.size:  # never measured: large enough for the fit to move it either way
            log_q[i] = floor[i] + 2 * math.log(UNSEEN / 1e-6)
        if steps:
            floor[i] = max(floor[i], math.log(ZERO_VARIANCE * total))
    return NoiseModel(
        Structure(), np.maximum(log_q, floor), np.maximum(log_r, floor), log_q.copy(), floor
    )


def likelihood_slopes(
    noise: NoiseModel, adjoint: Adjoint, dt: float, starts: Array | None = None
) -> Array:
    """Return d loglik / d log variance, (2 or 3, n): of w, v and, if any, the coloured part.

    `starts` are those of `started`, of the same runs.
    """
    n = len(noise.log_q)
    q, r = np.exp(noise.log_q) / noise.weight_w, np.exp(noise.log_r) / noise.weight_v
    parts = [(q, adjoint.r[..., :n], adjoint.N[..., :n]), (r, adjoint.u, adjoint.D)]
    phi = noise.structure.phi(dt)
    if phi is not None:
        eta = np.exp(noise.log_c) * (1 - phi**2)
        parts.append((eta, adjoint.r[..., n:], adjoint.N[..., n:]))
    found = np.stack([0.5 * (v * (s**2 - c)).sum(axis=(0, 1)) for v, s, c in parts])
    if starts is not None:
        for row, log, own in zip(
            found[1:], noise.logs[1:], (starts[:, :n], starts[:, n:]), strict=False
        ):
            row += 0.5 * np.exp(log) * own.sum(axis=0)
    return found


def started(g: kalman.Gains, white: Array, phi: float | None) -> Array:
    """Return twice the slope of loglik by the variance of each run's start, (B, n or 2 n).

    A start has the variance of its measurement, and that of the coloured part, so both show in it,
    once a run. Without this part (`likelihood_slopes`), fits of many short runs would stop beside
    the maximum.

    Args:
        g: gains of the runs (L, B, ...), none of them delayed.
        white: whitened innovations (L, B, n).
        phi: correlation of the coloured part over one step, if there is one.
    """
    L, B, n = white.shape
    L, G = min(L, REMEMBERED), g.system.G
    K = n if phi is None else 2 * n
    d, r = (np.zeros((T, B, n, kalman.whole(K, n))) for T in (L, L + 1))
    r[0, ..., :n] = np.eye(n)
    if phi is not None:
        fades = (phi ** np.arange(L))[:, None, None, None]
        d[..., n:K] = fades * (np.eye(n) if G is None else G[:L])
    moves = kalman.innovations(g.of_steps(L), d, r)[0][..., :K].swapaxes(0, 1)
    moves = moves.reshape(B, L * n, K)
    score = (white[:L].swapaxes(0, 1).reshape(B, 1, L * n) @ moves)[:, 0]
    found = score**2 - np.square(moves).sum(axis=1)
    found[:, :n] *= g.system.seen[0] > 0
    return np.asarray(found)


def climbed(noise: NoiseModel, slope: Array, info: Array, count: int) -> NoiseModel:
    """Take one scoring step in all variances together.

    The step is taken and bounded along each principal direction of the information separately, so
    that it is an ascent step even where the information is poorly conditioned. For one variance v
    of N numbers with mean square s, the slope N (s / v - 1) / 2 over the average information
    N s / (2 v) is a = 1 - v / s; the step -log(1 - a) reaches v = s at once from any distance.

    Args:
        noise: the current noise.
        slope: from `likelihood_slopes`, (2 or 3, n).
        info: average information of all log variances (K, K).
        count: number of time steps in all runs.
    """
    logs = np.stack(noise.logs[: len(slope)])
    free = ((logs > noise.floor) | (slope > 0)).reshape(-1)
    size, axes = np.linalg.eigh(info[np.ix_(free, free)])
    along = axes.T @ slope.reshape(-1)[free] / np.maximum(size, 2e-5 * count)
    step = np.zeros(free.shape)
    step[free] = axes @ np.clip(-np.log1p(-np.minimum(along, 0.9)), -2.5, 2.5)
    moved = np.maximum(logs + step.reshape(slope.shape), noise.floor)
    log_c = moved[2] if len(slope) > 2 else noise.log_c
    return replace(noise, log_q=moved[0], log_r=moved[1], log_c=log_c)


def cleaned(noise: NoiseModel, adjoint: Adjoint) -> NoiseModel:
    """Do one round of outlier weights: variances from weighted disturbances, then new weights."""
    n = len(noise.log_q)
    q_t, r_t = np.exp(noise.log_q) / noise.weight_w, np.exp(noise.log_r) / noise.weight_v
    w2 = _moment(q_t, adjoint.r[..., :n], adjoint.N[..., :n])
    v2 = _moment(r_t, adjoint.u, adjoint.D)
    log_q = np.log((noise.weight_w * w2).mean(axis=(0, 1)) + 1e-300)
    log_r = np.log((noise.weight_v * v2).mean(axis=(0, 1)) + 1e-300)
    log_q = np.maximum(noise.log_q + np.clip(log_q - noise.log_q, -1.0, 0.5), noise.floor)
    log_r = np.maximum(noise.log_r + np.clip(log_r - noise.log_r, -1.0, 0.5), noise.floor)
    return replace(
        noise,
        log_q=log_q,
        log_r=log_r,
        weight_w=(DOF + 1) / (DOF + w2 / np.exp(log_q)),
        weight_v=(DOF + 1) / (DOF + v2 / np.exp(log_r)),
    )


def _moment(variance: Array, score: Array, cover: Array) -> Array:
    """Return E[w^2] given the data."""
    return np.maximum((variance * score) ** 2 + variance - variance**2 * cover, 0.0)


def working(
    noise: NoiseModel,
    adjoint: kalman.Adjoint,
    G: Array | None,
    dt: float,
    into: tuple[Array, Array],
) -> None:
    """Fill in the columns of d and r from which `average` computes the information.

    Args:
        noise: the current noise; K is 2 n, or 3 n with a coloured part.
        adjoint: the smoother's, of the runs under this noise.
        G: how noise enters (L, B, n, n), None for the identity.
        dt: time step [s].
        into: d (L, B, n, K) and r (L + 1, B, n, K), zeros.
    """
    L, B, n = adjoint.u.shape
    phi, i, (d, r) = noise.structure.phi(dt), np.arange(n), into

    def enter(at: int, sizes: Array) -> None:
        if G is None:
            d[..., i, at + i] = sizes
        else:
            np.multiply(G, sizes[..., None, :], out=d[..., at : at + n])

    enter(0, _scaled(noise.log_q, noise.weight_w, adjoint.r[..., :n]))
    # the opposite sign of d, which enters the prediction
    r[1:, ..., i, n + i] = -_scaled(noise.log_r, noise.weight_v, adjoint.u)
    if phi is not None:
        kicks = np.exp(noise.log_c) * (1 - phi**2) * adjoint.r[..., n:]
        c = np.zeros((L, B, n))
        for t in range(1, L):
            c[t] = phi * c[t - 1] + kicks[t - 1]
        enter(2 * n, c)


def _scaled(log_variance: Array, weight: Array | float, adjoint: Array) -> Array:
    return np.asarray(np.exp(log_variance) / weight * adjoint)


def average(white: Array) -> Array:
    """Return the average information (K, K) from the whitened columns of `working`."""
    flat = white.reshape(-1, white.shape[-1])
    return np.asarray(0.5 * (flat.T @ flat))  # of one matrix: half the products
