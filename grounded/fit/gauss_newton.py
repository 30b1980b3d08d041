"""Levenberg and Marquardt's climb of the likelihood for a given noise, within bounds.

    delta = -(W'W + lambda diag(W'W))^-1 W' eps,       theta <- clip(theta + delta)

A step counts if the log-likelihood rises; else lambda grows. Unknowns at a bound that would leave
it are held; directions of which the data say nothing are not moved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grounded.estimate import Noise
from grounded.fit.innovations import Data, Linear, Point, linear, point
from grounded.frozen import Array

ENOUGH = 0.002  # [nats] a step that promises less, a sixteenth of a std, is the last
NOTHING = 1e-9  # of the largest eigenvalue (scaled): below it the data say nothing


@dataclass(frozen=True, eq=False)
class Climb:
    """Where a climb ended and why."""

    at: Point
    slopes: Linear
    steps: int
    status: str


def climb(
    data: Data,
    noise: Noise,
    start: Point,
    free: NDArray[np.bool_],
    max_steps: int = 20,
) -> Climb:
    """Climbs from a point; only `free` unknowns (k,) move.

    Args:
        data: the records.
        noise: held fixed.
        start: a point at this noise, whose filter got through.
        free: which unknowns may move, (k,).
        max_steps: steps that count, at most.
    """
    at, damping, status = start, 1e-3, "out of steps"
    slopes = linear(data, at)
    for step in range(max_steps):
        at, slopes, damping, status = _step(data, noise, at, slopes, free, damping)
        if status != "rising":
            return Climb(at, slopes, step, status)
    return Climb(at, slopes, max_steps, "out of steps")


def _step(
    data: Data,
    noise: Noise,
    at: Point,
    slopes: Linear,
    free: NDArray[np.bool_],
    damping: float,
) -> tuple[Point, Linear, float, str]:
    for _ in range(12):
        delta, promise = direction(data, at.theta, slopes, free, damping)
        if promise < ENOUGH:
            return at, slopes, damping, "converged"
        there = point(data, noise, data.unknowns.clipped(at.theta + delta), at)
        if there.loglik > at.loglik:
            gain = there.loglik - at.loglik
            later = linear(data, there)
            if not np.isfinite(later.W).all():
                return at, slopes, damping, "slopes are not finite"
            status = "rising" if gain > ENOUGH else "converged"
            return there, later, max(damping / 10, 1e-8), status
        damping *= 10
    return at, slopes, damping, "no step rises further"


def direction(
    data: Data, theta: Array, slopes: Linear, free: NDArray[np.bool_], damping: float
) -> tuple[Array, float]:
    """The damped step (k,) and the gain in nats that the linear problem promises of it."""
    unknowns = data.unknowns
    N, g = slopes.W.T @ slopes.W, -slopes.W.T @ slopes.eps
    stuck = ((theta <= unknowns.low) & (g < 0)) | ((theta >= unknowns.high) & (g > 0))
    use = np.flatnonzero(free & ~stuck & (np.diag(N) > 0))
    delta = np.zeros(unknowns.k)
    if len(use) == 0:
        return delta, 0.0
    scale = 1 / np.sqrt(np.diag(N)[use])
    scaled = N[np.ix_(use, use)] * np.outer(scale, scale)
    values, vectors = np.linalg.eigh(scaled)
    said = values > NOTHING * values[-1]
    along = vectors[:, said].T @ (g[use] * scale)
    delta[use] = scale * (vectors[:, said] @ (along / (values[said] + damping)))
    delta = unknowns.clipped(theta + delta) - theta
    return delta, float(g @ delta - 0.5 * delta @ N @ delta)
