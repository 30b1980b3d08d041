"""The noise of a real system: estimated, never assumed.

Process noise w (var Q) and measurement noise v (var R), diagonal, each channel its own. Two ways in
which real noise differs from the textbook's, allowed before an effect is claimed:

    coloured   beside w, a disturbance c_{t+1} = phi c_t + eta with phi = exp(-dt / tau): a gust, a
               carpet, a swaying antenna (variance C of c, a channel)
    heavy      v and w are Student-t of 4 degrees of freedom: each is normal with a precision lambda
               drawn from Gamma(dof / 2, dof / 2). Variational Bayes gives each its own weight
               E[lambda] = (dof + 1) / (dof + E[v^2] / R); outliers count for little.

Variances climb the likelihood by scoring, each channel by itself: with the smoother's adjoint r and
its covariance N, d loglik / d log q = q sum(r^2 - N) / 2 and the information is about sum((q N)^2) / 2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from grounded.diagnosis.filter import Adjoint
from grounded.frozen import Array

DOF = 4.0


@dataclass(frozen=True)
class Structure:
    """Which noise is allowed: tau [s] of a coloured part or None, heavy tails or not."""

    tau: float | None = None
    heavy: bool = False

    def phi(self, dt: float) -> float | None:
        """The coloured part's correlation over a step."""
        return None if self.tau is None else math.exp(-dt / self.tau)

    def numbers(self, n: int) -> int:
        """How many more numbers than plain white noise it estimates."""
        return (0 if self.tau is None else n + 1) + (1 if self.heavy else 0)


@dataclass(frozen=True, eq=False)
class Noise:
    """Log variances (n,) of w, v and c; weights of heavy tails (L, B, n) or 1.0."""

    structure: Structure
    log_q: Array
    log_r: Array
    log_c: Array
    floor: Array  # (n,) log variance below which nothing is resolved
    weight_w: Array | float = 1.0
    weight_v: Array | float = 1.0

    def process(self, dt: float) -> Array | float:
        """Q for the filter: (L, B, N) or (N,)."""
        q = np.exp(self.log_q) / self.weight_w
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

    def start(self, runs: int) -> Array:
        """Variance of the coloured part at t = 0, (B, 0 or n)."""
        if self.structure.tau is None:
            return np.zeros((runs, 0))
        return np.tile(np.exp(self.log_c), (runs, 1))

    def allowing(self, structure: Structure) -> Noise:
        """The same noise, free to be coloured or heavy-tailed: where its fit starts."""
        return replace(
            self,
            structure=structure,
            log_q=self.log_q - (0.7 if structure.tau is not None else 0.0),
            log_c=np.maximum(self.log_q - 1.5, self.floor),
            weight_w=1.0,
            weight_v=1.0,
        )


def first_guess(residual: Array, seen: Array, scale: Array) -> Noise:
    """Variances from one-step residuals of the raw measurements, (L, B, n).

    A residual's variance is about q + 2 r and its lag-one covariance -r; robust by medians.
    """
    n = residual.shape[-1]
    floor = 2 * np.log(1e-6 * scale + 1e-300)
    log_q, log_r = np.empty(n), np.empty(n)
    for i in range(n):
        good = seen[1:, :, i] > 0
        e = residual[:, :, i]
        values = e[good]
        spread = 1.4826 * np.median(np.abs(values - np.median(values))) if values.size else 0.0
        total = max(spread**2, 1e-4 * float(np.var(values)) if values.size else 0.0, 1e-30)
        clipped = np.clip(e, -5 * spread - 1e-30, 5 * spread + 1e-30)
        both = good[1:] & good[:-1]
        lagged = float(np.mean((clipped[1:] * clipped[:-1])[both])) if both.any() else 0.0
        r = min(max(-lagged, 0.02 * total), 0.45 * total)
        log_r[i], log_q[i] = math.log(r), math.log(max(total - 2 * r, 0.05 * total))
    return Noise(
        Structure(), np.maximum(log_q, floor), np.maximum(log_r, floor), log_q.copy(), floor
    )


def climbed(noise: Noise, adjoint: Adjoint, dt: float, boldness: float = 1.0) -> Noise:
    """One scoring step up the likelihood; `boldness` scales it."""
    n = len(noise.log_q)
    q_t, r_t = np.exp(noise.log_q) / noise.weight_w, np.exp(noise.log_r) / noise.weight_v

    def step(log: Array, variance: Array, score: Array, cover: Array) -> Array:
        count = score.shape[0] * score.shape[1]
        slope = (variance * (score**2 - cover)).sum(axis=(0, 1))
        info = ((variance * cover) ** 2).sum(axis=(0, 1)) + 1e-3 * count
        moved = log + np.clip(boldness * slope / info, -1.0, 1.0)
        return np.maximum(moved, noise.floor)

    log_q = step(noise.log_q, q_t, adjoint.r[..., :n], adjoint.N[..., :n])
    log_r = step(noise.log_r, r_t, adjoint.u, adjoint.D)
    log_c, phi = noise.log_c, noise.structure.phi(dt)
    if phi is not None:
        eta = np.exp(noise.log_c) * (1 - phi**2)
        log_c = step(noise.log_c, eta, adjoint.r[..., n:], adjoint.N[..., n:])
    return replace(noise, log_q=log_q, log_r=log_r, log_c=log_c)


def reweighted(noise: Noise, adjoint: Adjoint) -> Noise:
    """Heavy tails: each disturbance's own weight, from what the smoother thinks of it."""
    if not noise.structure.heavy:
        return noise
    n = len(noise.log_q)
    w2 = _moment(np.exp(noise.log_q) / noise.weight_w, adjoint.r[..., :n], adjoint.N[..., :n])
    v2 = _moment(np.exp(noise.log_r) / noise.weight_v, adjoint.u, adjoint.D)
    return replace(
        noise,
        weight_w=(DOF + 1) / (DOF + w2 / np.exp(noise.log_q)),
        weight_v=(DOF + 1) / (DOF + v2 / np.exp(noise.log_r)),
    )


def _moment(variance: Array, score: Array, cover: Array) -> Array:
    """E[w^2] given the data."""
    return np.maximum((variance * score) ** 2 + variance - variance**2 * cover, 0.0)


def tail_bound(noise: Noise, seen: Array) -> float:
    """What the weights add to the variational bound of the log-likelihood.

    sum over disturbances of (E[log lambda] - log E[lambda]) / 2 - KL(q(lambda) | Gamma(dof/2, dof/2)),
    with q(lambda) = Gamma(a, a / E[lambda]), a = (dof + 1) / 2.
    """
    if not noise.structure.heavy or isinstance(noise.weight_w, float):
        return 0.0
    a, a0 = (DOF + 1) / 2, DOF / 2
    psi = digamma(a)
    total = 0.0
    for weight in (noise.weight_w, noise.weight_v):
        b = a / np.asarray(weight)
        kl = (a - a0) * psi - math.lgamma(a) + math.lgamma(a0)
        kl = kl + a0 * (np.log(b) - math.log(a0)) + a * (a0 - b) / b
        total += float(((0.5 * (psi - math.log(a)) - kl) * seen[1:]).sum())
    return total


def digamma(x: float) -> float:
    """psi(x) for x > 0, by recurrence and its asymptotic series (Abramowitz & Stegun 6.3.18)."""
    value = 0.0
    while x < 8:
        value -= 1 / x
        x += 1
    return value + math.log(x) - 1 / (2 * x) - 1 / (12 * x**2) + 1 / (120 * x**4) - 1 / (252 * x**6)
