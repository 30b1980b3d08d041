"""A lift's drive with different gains upwards and downwards, and dry friction in its guides.

w' = (up or down) volts - b w - c sign(w)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded.model import Model, Param

WIDTH = 0.05  # [m/s] speed over which the friction builds up


def dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    """Return ds/dt."""
    push = np.where(a.volts > 0, p.up, p.down) * a.volts
    dry = np.minimum(np.maximum(s.w / WIDTH, -1.0), 1.0)
    return {"z": s.w, "w": push - p.b * s.w - p.c * dry}


model = Model(
    name="lift",
    states={"z": "m", "w": "m/s"},
    inputs={"volts": "V"},
    params={
        "up": Param(1.0, "m/(s^2 V)", 0.2, 4.0),
        "down": Param(1.6, "m/(s^2 V)", 0.2, 4.0),
        "b": Param(2.0, "1/s", 0.1, 10.0),
        "c": Param(0.8, "m/s^2", 0.0, 5.0),
    },
    roles={"altitude": "z"},
    derivative=dynamics,
)
