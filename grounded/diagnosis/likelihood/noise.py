"""The noise of a real system: estimated, never assumed.

Process noise w (var Q) and measurement noise v (var R), diagonal, each channel its own. Two ways in
which real noise differs from the textbook's, allowed before an effect is claimed:

    coloured   beside w, a disturbance c_{t+1} = phi c_t + eta with phi = exp(-dt / tau): a gust, a
               carpet, a swaying antenna (variance C of c, a channel)
    heavy      v and w are Student-t of 4 degrees of freedom: each is normal with its own precision,
               whose expectation weighs it, (dof + 1) / (dof + E[v^2] / R). The weights are found
               for one fit (`cleaned`) and then belong to the data: every hypothesis is judged with
               the same ones, so that outliers count for little and favour nobody.

Variances climb the likelihood by scoring: with the smoother's adjoint r and its covariance N,
d loglik / d log q = q sum(r^2 - N) / 2. Channels share their noise: an encoder's noise can pass for
a disturbance of the speed behind it. So all variances step together, by the average of observed and
expected information (Gilmour, Thompson & Cullis 1995, "Average information REML"). With P the
inverse covariance of the data and V_i what noise i adds to it,

    AI_ij = 1/2 (V_i P y)' P (V_j P y)

P y is what the smoother says of each disturbance, so V_i P y is the answer of the system to the
disturbance variance_i * adjoint_i: one more column for the filter. Never indefinite, exact where it
matters, and one pass for all of them.
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
UNSEEN = 1e-2  # of a state's scale: the disturbance of one that is never measured, at first
NOTHING = 1e-4  # part of a channel's one-step variance below which a variance is nil


@dataclass(frozen=True)
class Structure:
    """Which noise is allowed beside white: tau [s] of a coloured part, or None."""

    tau: float | None = None

    def phi(self, dt: float) -> float | None:
        """The coloured part's correlation over a step."""
        return None if self.tau is None else math.exp(-dt / self.tau)

    def numbers(self, n: int) -> int:
        """How many more numbers than plain white noise it estimates, in effect.

        A correlation time and one variance: in most channels the coloured part is nil and costs
        nothing. Charging all n + 1 would make a claim cheaper than coloured noise.
        """
        return 0 if self.tau is None else 2


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Log variances (n,) of w, v and c; weights of heavy tails (L, B, n) or 1.0."""

    structure: Structure
    log_q: Array
    log_r: Array
    log_c: Array
    floor: Array  # (n,) log variance below which nothing is resolved
    weight_w: Array | float = 1.0
    weight_v: Array | float = 1.0

    @property
    def logs(self) -> tuple[Array, Array, Array]:
        """All log variances, the coloured part's last."""
        return self.log_q, self.log_r, self.log_c

    def process(self, dt: float) -> Array:
        """Q for the filter: (L, B, N) or (N,)."""
        q = np.asarray(np.exp(self.log_q) / self.weight_w)
        phi = self.structure.phi(dt)
        if phi is None:
            return q
        eta = np.exp(self.log_c) * (1 - phi**2)
        return np.concatenate([q, np.broadcast_to(eta, q.shape)], axis=-1)

    def measurement(self, steps: int) -> Array:
        """R for the filter: (L + 1, 1 or B, n)."""
        r = np.exp(self.log_r) / self.weight_v
        if r.ndim == 1:
            return np.broadcast_to(r, (steps + 1, 1, len(r)))
        return np.concatenate([np.broadcast_to(np.exp(self.log_r), r[:1].shape), r])

    @property
    def plain(self) -> NoiseModel:
        """Without weights, its variances what w and v come to with their outliers."""
        if isinstance(self.weight_w, float) or isinstance(self.weight_v, float):
            return self
        w, v = ((DOF + 1) / weight - DOF for weight in (self.weight_w, self.weight_v))
        log_q, log_r = (
            log + np.log(np.maximum(size.mean(axis=(0, 1)), 1e-12))
            for log, size in ((self.log_q, w), (self.log_r, v))
        )
        return replace(self, log_q=log_q, log_r=log_r, weight_w=1.0, weight_v=1.0)

    def start(self, runs: int) -> Array:
        """Variance of the coloured part at t = 0, (B, 0 or n)."""
        if self.structure.tau is None:
            return np.zeros((runs, 0))
        return np.tile(np.exp(self.log_c), (runs, 1))

    def behind(self, now: Mapping[int, int]) -> NoiseModel:
        """The same with what disturbs late logs in their true values of the moment, {log: true}.

        A late log is an old true value and nothing else: what it seems to be disturbed by was seen
        late. Were nothing to disturb the true value, no log would ever correct it.
        """
        if not now:
            return self
        log_q, floor = self.log_q.copy(), self.floor.copy()
        for log, true in now.items():
            log_q[true], floor[true], log_q[log] = log_q[log], floor[log], floor[log]
        return replace(self, log_q=log_q, log_c=log_q.copy(), floor=floor)

    def allowing(self, structure: Structure, dt: float) -> NoiseModel:
        """The same noise, free to be coloured (or not): where its fit starts."""
        if structure.tau is None:
            return replace(self, structure=structure)
        # a tenth of the low-frequency power: summed over time c has about 2 tau / dt times its own
        share = math.log(0.1 * dt / (2 * structure.tau))
        log_c = np.maximum(self.log_q + share, self.floor)
        return replace(self, structure=structure, log_c=log_c)

    def towards(self, other: NoiseModel, part: float) -> NoiseModel:
        """Part of the way to another noise of the same structure."""
        if part == 1.0 or other is self:
            return other
        logs = {
            name: getattr(self, name) + part * (getattr(other, name) - getattr(self, name))
            for name in ("log_q", "log_r", "log_c")
        }
        return replace(self, **logs)


def noise_guess(residual: Array, seen: Array, scale: Array) -> NoiseModel:
    """Variances from one-step residuals of the raw measurements, (L, B, n).

    A residual's variance is about q + 2 r and its lag-one covariance -r; robust by medians.
    """
    n = residual.shape[-1]
    floor = 2 * np.log(1e-6 * scale + 1e-300)
    log_q, log_r = np.empty(n), np.empty(n)
    for i in range(n):
        good = (seen[1:, :, i] > 0) & (seen[:-1, :, i] > 0)
        steps = bool(good.any())  # else what is held from sample to sample is no step
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
        if not values.size:  # never measured: from where its disturbance can be seen, up or down
            log_q[i] = floor[i] + 2 * math.log(UNSEEN / 1e-6)
        if steps:
            floor[i] = max(floor[i], math.log(NOTHING * total))
    return NoiseModel(
        Structure(), np.maximum(log_q, floor), np.maximum(log_r, floor), log_q.copy(), floor
    )


def likelihood_slopes(noise: NoiseModel, adjoint: Adjoint, dt: float) -> Array:
    """Slope d loglik / d log variance, (2 or 3, n): of w, v and, if any, the coloured part."""
    n = len(noise.log_q)
    q, r = np.exp(noise.log_q) / noise.weight_w, np.exp(noise.log_r) / noise.weight_v
    parts = [(q, adjoint.r[..., :n], adjoint.N[..., :n]), (r, adjoint.u, adjoint.D)]
    phi = noise.structure.phi(dt)
    if phi is not None:
        eta = np.exp(noise.log_c) * (1 - phi**2)
        parts.append((eta, adjoint.r[..., n:], adjoint.N[..., n:]))
    return np.stack([0.5 * (v * (s**2 - c)).sum(axis=(0, 1)) for v, s, c in parts])


def climbed(noise: NoiseModel, slope: Array, info: Array, count: int) -> NoiseModel:
    """One step up the likelihood, all variances together.

    Along each principal direction of the information by itself, bounded there: so the step goes up
    even where the information is poor. For one variance v of N numbers whose mean square is s, the
    slope N (s / v - 1) / 2 over the average information N s / (2 v) is a = 1 - v / s; the step
    -log(1 - a) leads to v = s at once, from however far.

    Args:
        noise: as it is.
        slope: from `slopes`, (2 or 3, n).
        info: (K, K) of all log variances.
        count: time steps in all.
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
    """One round of outlier weights: scales from the weighted disturbances, then new weights."""
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
    """E[w^2] given the data."""
    return np.maximum((variance * score) ** 2 + variance - variance**2 * cover, 0.0)


def working(
    noise: NoiseModel,
    adjoint: kalman.Adjoint,
    G: Array | None,
    dt: float,
    into: tuple[Array, Array],
) -> None:
    """What each noise, as the smoother sees it, adds to d (L, B, n, K) and r (L + 1, B, n, K).

    Args:
        noise: K is 2 n, or 3 n with a coloured part.
        adjoint: of the runs under this noise.
        G: how noise enters (L, B, n, n), None for the identity.
        dt: [s].
        into: d and r, zeros.
    """
    L, B, n = adjoint.u.shape
    phi, i, (d, r) = noise.structure.phi(dt), np.arange(n), into

    def enter(at: int, sizes: Array) -> None:
        if G is None:
            d[..., i, at + i] = sizes
        else:
            np.multiply(G, sizes[..., None, :], out=d[..., at : at + n])

    enter(0, _scaled(noise.log_q, noise.weight_w, adjoint.r[..., :n]))
    r[1:, ..., i, n + i] = -_scaled(noise.log_r, noise.weight_v, adjoint.u)  # d is foreseen, not r
    if phi is not None:
        kicks = np.exp(noise.log_c) * (1 - phi**2) * adjoint.r[..., n:]
        c = np.zeros((L, B, n))
        for t in range(1, L):
            c[t] = phi * c[t - 1] + kicks[t - 1]
        enter(2 * n, c)


def _scaled(log_variance: Array, weight: Array | float, adjoint: Array) -> Array:
    return np.asarray(np.exp(log_variance) / weight * adjoint)


def average(white: Array) -> Array:
    """The average information (K, K) from whitened working columns (L, B, n, K)."""
    flat = white.reshape(-1, white.shape[-1])
    return np.asarray(0.5 * flat.T @ flat)
