"""The slope of one step in the model's parameters, thresholds included.

A threshold (the throttle below which a motor stalls) has no derivative: a small change moves no
sample across it. Where a parameter's derivative is zero at every sample, the secant over a few
per cent of its size takes its place, so that a threshold that is off is found like any other
parameter, and not blamed on an effect.
"""

from __future__ import annotations

import numpy as np

from grounded.diagnosis.hypothesis import param_scale
from grounded.frozen import Array
from grounded.model import Model

PART = 0.05  # of a parameter's size, to each side


def sensitivities(model: Model, x: Array, u: Array, p: Array, dt: float) -> tuple[Array, Array]:
    """f_x (N, n, n) and f_p (N, n, k) of one step from x (N, n) with received inputs u (N, m)."""
    f_x, _, f_p = model.system.sensitivities(x, u, p, dt)
    flat = np.flatnonzero(~f_p.any(axis=(0, 1)) & (param_scale(model) > 0))
    for i in flat:
        size = PART * param_scale(model)[i]
        ends = []
        for sign in (-1, 1):
            moved = p.copy()
            moved[i] += sign * size
            ends.append(model.system.step(x, u, moved, dt))
        f_p[:, :, i] = model.difference(ends[1], ends[0]) / (2 * size)
    return f_x, f_p
