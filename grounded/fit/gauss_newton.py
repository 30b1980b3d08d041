"""Levenberg and Marquardt's climb of the likelihood for a given noise, within bounds.

The least-squares problem are the whitened innovations and their slopes (`point`),

    delta = -(W'W + lambda diag(W'W))^-1 W' eps,     theta <- clip(theta + delta)

Because every step of a trial starts from what the filter knows, noise of the measurements does not
bias the fit, as it does in one-step least squares (errors in variables).

Gauss and Newton leave out that the filter's gains depend on theta too, and where the model stiffens
with theta the step then leads down and theta would stay where it began. So a climb that rises no
further goes on with the exact slope (`exact`), and ends where that has none.

A step counts if the log-likelihood rises; else lambda grows. Unknowns at a bound that would leave
it are held; directions of which the data say nothing are not moved.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grounded.estimate import NoiseStd
from grounded.fit.point import FitData, Linear, Point, exact, linear, point
from grounded.frozen import Array

ENOUGH = 0.002  # [nats] a step that promises less, a sixteenth of a std, is the last
WHOLE = 1e-9  # of a step: rounding
NOTHING = 1e-9  # of the largest eigenvalue (scaled): below it the data say nothing


@dataclass(frozen=True, eq=False)
class Climb:
    """Where a climb ended and why."""

    at: Point
    slopes: Linear
    steps: int
    status: str


def climb(
    data: FitData,
    noise: NoiseStd,
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
    at, damping, last = start, 1e-3, max_steps
    slopes_at: Callable[[FitData, Point], Linear] = linear
    slopes = linear(data, at)
    for step in range(max_steps):
        at, slopes, damping, status = _step(data, noise, at, slopes, free, damping, slopes_at)
        if status != "rising" and slopes_at is exact:
            return Climb(at, slopes, step, status)
        if status != "rising":
            damping, slopes_at, slopes = 1e-3, exact, exact(data, at)
            last = min(last, step + 1 + max_steps // 2)
        if step + 1 == last:
            break
    return Climb(at, slopes, max_steps, "out of steps")


def _step(
    data: FitData,
    noise: NoiseStd,
    at: Point,
    slopes: Linear,
    free: NDArray[np.bool_],
    damping: float,
    slopes_at: Callable[[FitData, Point], Linear],
) -> tuple[Point, Linear, float, str]:
    for _ in range(12):
        delta, promise = marquardt_step(data, at.theta, slopes, free, damping)
        if promise < ENOUGH:
            return at, slopes, damping, "converged"
        there = point(data, noise, data.unknowns.clipped(at.theta + delta), at)
        if there.loglik > at.loglik:
            gain = there.loglik - at.loglik
            later = slopes_at(data, there)
            if not np.isfinite(later.N).all():
                return at, slopes, damping, "slopes are not finite"
            status = "rising" if gain > ENOUGH else "converged"
            return there, later, max(damping / 10, 1e-8), status
        damping *= 10
    return at, slopes, damping, "no step rises further"


def marquardt_step(
    data: FitData, theta: Array, slopes: Linear, free: NDArray[np.bool_], damping: float
) -> tuple[Array, float]:
    """The damped step (k,) and the gain in nats that the linear problem promises of it.

    An unknown that would leave its bounds stops there, and the others step as is best with it
    there: clipped afterwards, they would rely on a move that is not made.
    """
    unknowns = data.unknowns
    N, g = slopes.N, slopes.g
    stuck = ((theta <= unknowns.low) & (g < 0)) | ((theta >= unknowns.high) & (g > 0))
    free, delta = free & ~stuck & (np.diag(N) > 0), np.zeros(unknowns.k)
    while (use := np.flatnonzero(free)).size:
        left = g[use] - N[use][:, ~free] @ delta[~free]
        step = _damped(N[np.ix_(use, use)], left, damping)
        inside = np.clip(theta[use] + step, unknowns.low[use], unknowns.high[use]) - theta[use]
        delta[use] = inside
        part = inside / np.where(step == 0, 1.0, step) + (step == 0)
        if (part > 1 - WHOLE).all():
            break
        free[use[np.argmin(part)]] = False  # the first to meet its bound
    return delta, float(g @ delta - 0.5 * delta @ N @ delta)


def _damped(N: Array, g: Array, damping: float) -> Array:
    """(N + damping diag(N))^-1 g, zero in directions of which the data say nothing."""
    scale = 1 / np.sqrt(np.diag(N))
    values, vectors = np.linalg.eigh(N * np.outer(scale, scale))
    said = values > NOTHING * values[-1]
    along = vectors[:, said].T @ (g * scale)
    return np.asarray(scale * (vectors[:, said] @ (along / (values[said] + damping))))
