"""Noise: how far a state strays in a step, and how far a measurement strays from the state.

    x_{t+1} = f(x_t, u_t) + w_t,  w ~ N(0, diag(process^2)),     y = h(x) + v,  v ~ N(0, diag(r^2))

Both are the data's to say: see `grounded.estimate.likelihood`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grounded.errors import GroundedError
from grounded.frozen import Array, readonly


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviations, in the units of the states and of the channels.

    Args:
        process: of w over `dt`, (n,); over another step h it is process * sqrt(h / dt).
        measurement: of v, (ny,).
        dt: [s].

    Raises:
        GroundedError: for a value that is negative or not finite, or a measurement without noise.
    """

    process: Array
    measurement: Array
    dt: float

    def __post_init__(self) -> None:
        for name in ("process", "measurement"):
            value = readonly(getattr(self, name))
            if value.ndim != 1 or not np.isfinite(value).all() or (value < 0).any():
                raise GroundedError(f"{name} noise must be finite standard deviations, got {value}")
            object.__setattr__(self, name, value)
        if (self.measurement == 0).any():
            raise GroundedError(
                "a measurement without noise can't be filtered: give it a small std"
            )
