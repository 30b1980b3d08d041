"""The quadratic cost J of `problem.py` and its derivatives, which need no model.

l_t(z, u) = W_t |x - target_t|^2 + R |u - u_target_t|^2 + S |u - u_{t-1}|^2 (no halves), so that
l_x = 2 W e and l_xx = 2 W. Errors of angles wrap.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grounded.compile.problem import Array, Problem


def wrapped(d: Array, angles: NDArray[np.bool_]) -> Array:
    """`d` (..., >= n) with the angles among its first n entries wrapped to [-pi, pi], in place."""
    for i in np.flatnonzero(angles):
        d[..., i] -= 2 * np.pi * np.rint(d[..., i] / (2 * np.pi))
    return d


def tracking_error(problem: Problem, z: Array) -> Array:
    """x_t - target_t, angles wrapped: z (..., H+1, nz) -> (..., H+1, n)."""
    return wrapped(z[..., : problem.system.n] - problem.target, problem.angles)


def input_change(problem: Problem, u: Array) -> Array:
    """u_t - u_{t-1} with u_{-1} = past: u (..., H, m) -> (..., H, m)."""
    before = np.broadcast_to(problem.past, (*u.shape[:-2], 1, u.shape[-1]))
    return np.diff(u, axis=-2, prepend=before)


def trajectory_cost(problem: Problem, z: Array, u: Array) -> Array:
    """J of each run: z (..., H+1, nz), u (..., H, m) -> (...,)."""
    with np.errstate(all="ignore"):
        e = tracking_error(problem, z)
        J = np.einsum("...ti,ti->...", e * e, problem.state_weight)
        a, change = u - problem.input_target, input_change(problem, u)
        J = J + (a * a).sum(axis=-2) @ problem.input_weight
        return np.asarray(J + (change * change).sum(axis=-2) @ problem.change_weight)
