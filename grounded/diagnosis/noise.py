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
d loglik / d log q = q sum(r^2 - N) / 2; the information is that of a channel by itself (`climbed`).
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
class Noise:
    """Log variances (n,) of w, v and c; weights of heavy tails (L, B, n) or 1.0."""

    structure: Structure
    log_q: Array
    log_r: Array
    log_c: Array
    floor: Array  # (n,) log variance below which nothing is resolved
    weight_w: Array | float = 1.0
    weight_v: Array | float = 1.0
    last: Array | None = None  # the steps that were taken last, (2 or 3, n)

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

    def start(self, runs: int) -> Array:
        """Variance of the coloured part at t = 0, (B, 0 or n)."""
        if self.structure.tau is None:
            return np.zeros((runs, 0))
        return np.tile(np.exp(self.log_c), (runs, 1))

    def allowing(self, structure: Structure, dt: float) -> Noise:
        """The same noise, free to be coloured (or not): where its fit starts."""
        if structure.tau is None:
            return replace(self, structure=structure, last=None)
        # a tenth of the low-frequency power: summed over time c has about 2 tau / dt times its own
        share = math.log(0.1 * dt / (2 * structure.tau))
        log_c = np.maximum(self.log_q + share, self.floor)
        return replace(self, structure=structure, log_c=log_c, last=None)


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


def climbed(
    noise: Noise, adjoint: Adjoint, memory: Array, dt: float, boldness: float = 1.0
) -> Noise:
    """One scoring step up the likelihood, all variances of a channel together.

    The slope is exact. The information is that of a channel by itself with x_{t+1} = m x_t + w: its
    measured differences have the spectrum f = q + r |1 - m e^{i omega}|^2 + coloured part, and the
    information of log a and log b, two parts of f, is T/2 mean_omega((a / f) (b / f)).

    Args:
        noise: as it is.
        adjoint: what the smoother says of every disturbance.
        memory: m of each channel (n,), the mean diagonal of the Jacobian.
        dt: [s].
        boldness: scales the step.
    """
    n, count = len(noise.log_q), adjoint.u.shape[0] * adjoint.u.shape[1]
    phi = noise.structure.phi(dt)
    logs = [noise.log_q, noise.log_r] + ([noise.log_c] if phi is not None else [])
    scores = [(adjoint.r[..., :n], adjoint.N[..., :n]), (adjoint.u, adjoint.D)]
    variances = [np.exp(noise.log_q) / noise.weight_w, np.exp(noise.log_r) / noise.weight_v]
    omega = np.linspace(0.02, np.pi, 40)[:, None]
    parts = [
        np.broadcast_to(np.exp(noise.log_q), (40, n)),
        np.exp(noise.log_r) * (1 - 2 * memory * np.cos(omega) + memory**2),
    ]
    if phi is not None:
        eta = np.exp(noise.log_c) * (1 - phi**2)
        scores.append((adjoint.r[..., n:], adjoint.N[..., n:]))
        variances.append(eta)
        parts.append(eta / (1 - 2 * phi * np.cos(omega) + phi**2))
    whole = np.sum(parts, axis=0)
    share = np.stack([part / whole for part in parts])  # (2 or 3, 40, n)
    info = 0.5 * count * np.einsum("afn,bfn->nab", share, share) / len(omega)
    slope = np.stack(
        [
            0.5 * (v * (s**2 - c)).sum(axis=(0, 1))
            for v, (s, c) in zip(variances, scores, strict=True)
        ]
    )
    info += 1e-3 * count * np.eye(len(logs))
    step = np.linalg.solve(info, slope.T[:, :, None])[:, :, 0].T
    step = np.clip(boldness * step, -1.5, 1.5)
    if noise.last is not None and noise.last.shape == step.shape:
        # a variance on its way to zero shrinks by a constant factor: Aitken's extrapolation
        ratio = step / np.where(noise.last == 0, 1.0, noise.last)
        steady = (ratio > 0.3) & (ratio < 1.2) & (noise.last != 0)
        step = np.where(steady, step / np.maximum(1 - ratio, 0.2), step)
        step = np.clip(step, -2.0, 2.0)
    moved = np.maximum(np.stack(logs) + step, noise.floor)
    return replace(
        noise,
        log_q=moved[0],
        log_r=moved[1],
        log_c=moved[2] if phi is not None else noise.log_c,
        last=moved - np.stack(logs),
    )


def cleaned(noise: Noise, adjoint: Adjoint) -> Noise:
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
        last=None,
    )


def _moment(variance: Array, score: Array, cover: Array) -> Array:
    """E[w^2] given the data."""
    return np.maximum((variance * score) ** 2 + variance - variance**2 * cover, 0.0)
