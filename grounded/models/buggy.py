"""A buggy that follows its commanded speed, slowly when driving and fast when braking.

v'   = (top drive - v) / tau,    tau = tau_drive where it drives, tau_brake where it brakes
psi' = v sin(a1 steering) / L

At constant speed it is exactly at the kink: noise makes it drive and brake alternately.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded.model import Model, Param


def dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    """Return ds/dt."""
    wanted = p.top * a.drive - s.v
    delta = p.a1 * a.steering
    return {
        "x": s.v * np.cos(s.psi),
        "y": s.v * np.sin(s.psi),
        "psi": s.v * np.sin(delta) / p.L,
        "v": np.where(wanted > 0, wanted / p.tau_drive, wanted / p.tau_brake),
    }


model = Model(
    name="buggy",
    states={"x": "m", "y": "m", "psi": "rad", "v": "m/s"},
    inputs={"steering": "1", "drive": "1"},
    params={
        "top": Param(4.0, "m/s", 1.0, 10.0),
        "tau_drive": Param(0.6, "s", 0.1, 3.0),
        "tau_brake": Param(0.2, "s", 0.05, 3.0),
        "a1": Param(0.4, "rad", 0.1, 1.0),
        "L": Param(0.3, "m", 0.1, 1.0),
    },
    angles=("psi",),
    roles={"position": ("x", "y"), "heading": "psi", "speed": "v"},
    derivative=dynamics,
)
