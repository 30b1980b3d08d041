"""A two-link arm in the vertical plane, driven by a torque at each joint."""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded.model import Model, Param

G = 9.81  # [m/s^2]


def dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    """Return ds/dt of two uniform rods with a load at the tip; angles up from the horizontal."""
    l1, c1, c2, m1, l2 = 0.5, 0.25, 0.2, 1.5, 0.4
    cos, sin = np.cos(s.q2), np.sin(s.q2)
    first, second = p.m2 * c2 + p.load * l2, p.m2 * c2**2 + p.load * l2**2 + 0.013333333333
    h = l1 * first
    m11 = m1 * c1**2 + 0.03125 + (p.m2 + p.load) * l1**2 + second + 2 * h * cos
    m12 = second + h * cos
    g2 = G * first * np.cos(s.q1 + s.q2)
    g1 = G * (m1 * c1 + (p.m2 + p.load) * l1) * np.cos(s.q1) + g2
    w1, w2 = s.q1_vel, s.q2_vel
    r1 = a.tau1 - p.b1 * w1 + h * sin * (2 * w1 * w2 + w2**2) - g1
    r2 = a.tau2 - p.b2 * w2 - h * sin * w1**2 - g2
    det = m11 * second - m12**2
    return {
        "q1": w1,
        "q2": w2,
        "q1_vel": (second * r1 - m12 * r2) / det,
        "q2_vel": (m11 * r2 - m12 * r1) / det,
    }


model = Model(
    name="arm",
    states={"q1": "rad", "q2": "rad", "q1_vel": "rad/s", "q2_vel": "rad/s"},
    inputs={"tau1": "N m", "tau2": "N m"},
    params={
        "m2": Param(1.0, "kg", 0.5, 2.0),
        "load": Param(0.0, "kg", 0.0, 1.0),
        "b1": Param(0.0, "N m s/rad", 0.0, 2.0),
        "b2": Param(0.0, "N m s/rad", 0.0, 2.0),
    },
    roles={"level": ("q1", "q2")},
    derivative=dynamics,
)
