"""The crude model of the car behind UDP: kinematic, speed and steering as commanded, with a lag."""

import numpy as np

from grounded import Model, Param


def dynamics(s, a, p):
    """ds/dt."""
    return {
        "v": (a.speed - s.v) / p.tau,
        "x": s.v * np.cos(s.psi),
        "y": s.v * np.sin(s.psi),
        "psi": s.v * np.tan(a.steering) / p.L,
    }


model = Model(
    name="car",
    states={"v": "m/s", "x": "m", "y": "m", "psi": "rad"},
    inputs={"steering": "rad", "speed": "m/s"},
    params={"tau": Param(0.2, "s", 0.05, 1.0), "L": Param(0.3, "m", 0.2, 0.4)},
    angles=("psi",),
    roles={"position": ("x", "y"), "heading": "psi", "speed": "v"},
    derivative=dynamics,
)
