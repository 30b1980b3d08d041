"""Levenberg-Marquardt maximisation of the likelihood for a given noise, within bounds.

The least-squares residuals are the whitened innovations eps, with the Jacobian W (`point`):

    delta = -(W'W + lambda diag(W'W))^-1 W' eps,     theta <- clip(theta + delta)

Every step of a trial starts from the filter's estimate, so measurement noise does not bias the fit,
as it does in one-step least squares (errors in variables).

Gauss-Newton neglects that the filter's gains depend on theta too. If the model gets stiffer with
theta, its steps may then decrease the likelihood, and theta would stay at its start. So when no
step increases the likelihood, the search continues with the gradient through the gains (`exact`)
until that gives no increase either, and, if that still promises some, with differences of the
likelihood (`differenced`).

A step is accepted if the log-likelihood increases; else lambda grows. Unknowns at a bound that the
step would leave are held; directions without information in the data are not moved.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grounded.estimate import NoiseStd
from grounded.fit.point import FitData, Linear, Point, differenced, exact, linear, point
from grounded.frozen import Array

ENOUGH = 0.002  # [nats] predicted gain below which the search ends; 1/16 of a standard deviation
DOUBTED = 1.0  # [nats] promised gain that does not come, above which a gradient is doubted
WHOLE = 1e-9  # rounding tolerance, as a fraction of a step
NOTHING = 1e-9  # eigenvalue, relative to the largest (scaled), treated as no information


@dataclass(frozen=True, eq=False)
class Climb:
    """The result of a climb: the last point, its derivatives, and why it ended."""

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
    """Maximise the likelihood from a point; only `free` unknowns move.

    Args:
        data: the records.
        noise: the noise, held fixed.
        start: a point with this noise and a finite likelihood.
        free: which unknowns may move, (k,).
        max_steps: most accepted steps.
    """
    at, damping, last = start, 1e-3, max_steps
    slopes_at: Callable[[FitData, Point], Linear] = linear
    slopes, better = linear(data, at), [exact, differenced]
    for step in range(max_steps):
        at, slopes, damping, status = _step(data, noise, at, slopes, free, damping, slopes_at)
        if status != "rising":
            promise = marquardt_step(data, at.theta, slopes, free, 1e-3)[1]
            if not better or (slopes_at is exact and promise < DOUBTED):
                return Climb(at, slopes, step, status)
            damping, slopes_at = 1e-3, better.pop(0)
            slopes = slopes_at(data, at)
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
    """Return the damped step (k,) and the gain [nats] that the linear problem predicts for it.

    An unknown that would leave its bounds stops there, and the step of the others is solved again
    with it held. If the step were clipped afterwards, the others would not be optimal.
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
    """Return (N + damping diag(N))^-1 g, zero in directions without information."""
    scale = 1 / np.sqrt(np.diag(N))
    values, vectors = np.linalg.eigh(N * np.outer(scale, scale))
    said = values > NOTHING * values[-1]
    along = vectors[:, said].T @ (g * scale)
    return np.asarray(scale * (vectors[:, said] @ (along / (values[said] + damping))))
