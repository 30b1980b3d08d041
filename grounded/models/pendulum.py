"""A torque-driven pendulum: the smallest example.

theta'' = (torque - b theta') / (m l^2) - (g / l) sin(theta),      theta = 0 hangs down
"""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded.model import Model, Param


def dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    """Return ds/dt."""
    inertia = p.m * p.l**2
    return {
        "theta": s.omega,
        "omega": (a.torque - p.b * s.omega) / inertia - p.g / p.l * np.sin(s.theta),
    }


model = Model(
    name="pendulum",
    states={"theta": "rad", "omega": "rad/s"},
    inputs={"torque": "N m"},
    params={
        "m": Param(1.0, "kg", 0.2, 5.0),
        "l": Param(0.5, "m", 0.1, 2.0),
        "b": Param(0.05, "N m s", 0.0, 1.0),
        "g": Param(9.81, "m/s^2", 9.7, 9.9),
    },
    angles=(),  # swing-ups count full turns: theta is not wrapped
    roles={"heading": "theta", "hanging": "theta"},
    derivative=dynamics,
)
