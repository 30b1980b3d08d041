"""A cart on a rail with a uniform pole on it, pushed by a force; theta is zero upright."""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded.model import Model, Param

G = 9.81  # [m/s^2]


def dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    """Return ds/dt of a cart and a uniform pole; theta is zero upright."""
    sin, cos = np.sin(s.theta), np.cos(s.theta)
    inertia = p.m * p.l**2 * 4 / 3
    force = a.force - p.b * s.x_vel + p.m * p.l * s.theta_vel**2 * sin
    det = (p.M + p.m) * inertia - (p.m * p.l * cos) ** 2
    return {
        "x": s.x_vel,
        "theta": s.theta_vel,
        "x_vel": (inertia * force - p.m * p.l * cos * p.m * G * p.l * sin) / det,
        "theta_vel": ((p.M + p.m) * p.m * G * p.l * sin - p.m * p.l * cos * force) / det,
    }


model = Model(
    name="cart-pole",
    states={"x": "m", "theta": "rad", "x_vel": "m/s", "theta_vel": "rad/s"},
    inputs={"force": "N"},
    params={
        "M": Param(1.0, "kg", 0.5, 2.0),
        "m": Param(0.3, "kg", 0.1, 0.6),
        "l": Param(0.5, "m", 0.3, 0.8),
        "b": Param(0.0, "N s/m", 0.0, 5.0),
    },
    angles=("theta",),
    roles={"rail": "x", "upright": "theta"},
    derivative=dynamics,
)
