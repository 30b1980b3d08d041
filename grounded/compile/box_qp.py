"""min 1/2 k'Hk + g'k subject to low <= k <= high, by projected Newton (Tassa et al. 2014).

The free set are the inputs that no bound holds back. On it a Newton step is exact, so a handful of
iterations end with the exact solution: the clamped set is then the right one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grounded.compile.problem import Array

MAX_ITERATIONS = 50
STOP = 1e-11  # on the free gradient, relative to |g|
ARMIJO = 0.1
ROUNDING = 1e-13  # of the value: a smaller rise is none


def solve(H: Array, b: Array) -> Array:
    """H^-1 b in float64."""
    return np.asarray(np.linalg.solve(H, b), np.float64)


def masked(H: Array, free: NDArray[np.bool_]) -> Array:
    """H with rows and columns of clamped inputs replaced by the identity's."""
    return np.asarray(np.where(free[:, None] & free, H, 0.0) + np.diag(np.where(free, 0.0, 1.0)))


def free_set(k: Array, gradient: Array, low: Array, high: Array) -> NDArray[np.bool_]:
    """Inputs that no bound holds back."""
    held = ((k <= low) & (gradient > 0)) | ((k >= high) & (gradient < 0)) | (low >= high)
    return np.asarray(~held)


def box_qp(H: Array, g: Array, low: Array, high: Array) -> tuple[Array, NDArray[np.bool_]]:
    """The minimiser k (m,) and its free set (m,), for a positive definite H (m, m).

    Low <= 0 <= high is not needed; low <= high is.
    """
    k = np.clip(-solve(H, g), low, high)
    floor = STOP * (1e-300 + float(np.abs(g).max()))
    free = np.ones(len(g), bool)
    for _ in range(MAX_ITERATIONS):
        gradient = g + H @ k
        free = free_set(k, gradient, low, high)
        if not np.any(np.abs(gradient[free]) > floor):
            break
        newton = -solve(masked(H, free), np.where(free, gradient, 0.0))
        k_next = _projected_search(H, g, k, newton, low, high)
        if np.array_equal(k_next, k):
            break
        k = k_next
    return k, free


def _projected_search(
    H: Array, g: Array, k: Array, newton: Array, low: Array, high: Array
) -> Array:
    """Moves k along the projected path clip(k + beta newton), halving beta until J falls enough."""
    value, gradient, beta = g @ k + 0.5 * k @ H @ k, g + H @ k, 1.0
    slack = ROUNDING * abs(value)
    for _ in range(40):
        trial = np.clip(k + beta * newton, low, high)
        change = g @ trial + 0.5 * trial @ H @ trial - value
        if change <= ARMIJO * gradient @ (trial - k) + slack:
            return np.asarray(trial)
        beta *= 0.5
    return k
