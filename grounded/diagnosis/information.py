"""What the data know of the noise: the average information of all log variances together.

Channels share their noise: an encoder's noise can pass for a disturbance of the speed behind it. So
the variances step together, by the average of observed and expected information (Gilmour, Thompson
& Cullis 1995, "Average information REML"). With P the inverse covariance of the data and V_i what
noise i adds to it,

    AI_ij = 1/2 (V_i P y)' P (V_j P y)

P y is what the smoother says of each disturbance, so V_i P y is the answer of the system to the
disturbance variance_i * adjoint_i: one more column for the filter. Never indefinite, exact where it
matters, and one pass for all of them.
"""

from __future__ import annotations

import numpy as np

from grounded.diagnosis import filter as kalman
from grounded.diagnosis.noise import Noise
from grounded.frozen import Array


def working(
    noise: Noise, adjoint: kalman.Adjoint, G: Array | None, dt: float
) -> tuple[Array, Array]:
    """What each noise, as the smoother sees it, adds to d (L, B, n, K) and r (L + 1, B, n, K).

    Args:
        noise: K is 2 n, or 3 n with a coloured part.
        adjoint: of the runs under this noise.
        G: how noise enters (L, B, n, n), None for the identity.
        dt: [s].
    """
    L, B, n = adjoint.u.shape
    phi = noise.structure.phi(dt)
    K, i = 2 * n if phi is None else 3 * n, np.arange(n)
    d, r = np.zeros((L, B, n, K)), np.zeros((L + 1, B, n, K))
    enters = np.eye(n) if G is None else G
    d[..., :n] = enters * _scaled(noise.log_q, noise.weight_w, adjoint.r[..., :n])[..., None, :]
    r[1:, :, i, n + i] = -_scaled(noise.log_r, noise.weight_v, adjoint.u)  # d is foreseen, r is not
    if phi is not None:
        kicks = np.exp(noise.log_c) * (1 - phi**2) * adjoint.r[..., n:]
        c = np.zeros((L, B, n))
        for t in range(1, L):
            c[t] = phi * c[t - 1] + kicks[t - 1]
        d[..., 2 * n :] = enters * c[..., None, :]
    return d, r


def _scaled(log_variance: Array, weight: Array | float, adjoint: Array) -> Array:
    return np.asarray(np.exp(log_variance) / weight * adjoint)


def average(white: Array) -> Array:
    """The average information (K, K) from whitened working columns (L, B, n, K)."""
    flat = white.reshape(-1, white.shape[-1])
    return np.asarray(0.5 * flat.T @ flat)
