"""Many small least-squares problems at once, each with its own damping.

    minimise |r_i(w_i)|^2,  low <= w_i <= high,      i = 1 .. N, independent of each other

Levenberg (1944), Marquardt (1963): (J'J + mu diag(J'J)) step = -J'r; mu falls by 5 after a step
that lowers the error and rises by 5 after one that doesn't. Problems whose error is below `solved`
rest, and those that gain less than SETTLED of it or can't gain. Bounds are kept by clipping the
step. What is not finite counts as an infinite error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grounded.frozen import Array

Rows = NDArray[np.intp]
SETTLED, STUCK = 1e-6, 1e4  # relative gain of a step, damping


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """residual(w, rows) -> (len(rows), k) and its jacobian -> (len(rows), k, q), for some rows."""

    residual: Callable[[Array, Rows], Array]
    jacobian: Callable[[Array, Rows], Array]
    low: Array  # (q,)
    high: Array  # (q,)
    solved: float


@dataclass(frozen=True, eq=False)
class Minimum:
    """Unknowns w (N, q) and the squared errors (N,)."""

    w: Array
    error: Array

    def better_of(self, other: Minimum, rows: Rows) -> Minimum:
        """Row by row the smaller error; `other` holds only the given rows."""
        chosen = other.error < self.error[rows]
        w, error = self.w.copy(), self.error.copy()
        w[rows[chosen]], error[rows[chosen]] = other.w[chosen], other.error[chosen]
        return Minimum(w, error)


def solve(batch: LeastSquares, w: Array, rows: Rows, iterations: int) -> Minimum:
    """Solves the given rows from w (len(rows), q)."""
    w = np.clip(w, batch.low, batch.high)
    r = batch.residual(w, rows)
    now = Minimum(w, _error(r))
    damping, settled = np.full(len(rows), 1e-3), np.zeros(len(rows), dtype=bool)
    for _ in range(iterations):
        open_ = np.flatnonzero((now.error > batch.solved) & ~settled & (damping < STUCK))
        if not len(open_):
            break
        J = batch.jacobian(now.w[open_], rows[open_])
        moved = np.clip(now.w[open_] + _step(r[open_], J, damping[open_]), batch.low, batch.high)
        r_moved = batch.residual(moved, rows[open_])
        error, before = _error(r_moved), now.error[open_]
        better = error < before
        r[open_[better]] = r_moved[better]
        settled[open_] = better & (error > (1 - SETTLED) * before) & np.isfinite(before)
        now = now.better_of(Minimum(moved, error), open_)
        damping[open_] = np.clip(damping[open_] * np.where(better, 0.2, 5.0), 1e-9, 1e6)
    return now


def _error(r: Array) -> Array:
    square = np.einsum("ik,ik->i", r, r)
    return np.where(np.isfinite(square), square, np.inf)


def _step(r: Array, J: Array, damping: Array) -> Array:
    usable: NDArray[np.bool_] = np.asarray(
        np.isfinite(J).all(axis=(1, 2)) & np.isfinite(r).all(axis=1)
    )
    if not usable.all():
        J = np.where(usable[:, None, None], J, 0.0)
        r = np.where(usable[:, None], r, 0.0)
    normal = J.swapaxes(1, 2) @ J
    index = np.arange(J.shape[2])
    diagonal = normal[:, index, index] + 1e-9
    normal[:, index, index] += damping[:, None] * diagonal + 1e-9
    gradient = (r[:, None, :] @ J)[:, 0]
    return np.asarray(-np.linalg.solve(normal, gradient[..., None])[..., 0])
