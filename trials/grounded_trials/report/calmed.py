"""Curves calmed for a picture: means over time where noise from step to step hides their course.

A residual divided by dt multiplies a sensor's noise by 1/dt: at 50 Hz, 5 mm of noise is 0.35 m/s.
White noise changes from step to step by sqrt(2) times its rms, and a sensor's noise by sqrt(3), as
it enters two consecutive residuals with opposite signs. The course of a system changes by less.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grounded.frozen import Array

WINDOWS = 60  # means of a calmed curve
ROUGH = 1.0  # ratio of the change from step to step to the values (rms) from which noise prevails


def window_of(curves: Sequence[Array]) -> int:
    """Return over how many steps to average curves that share a panel; 1 if they are calm.

    Args:
        curves: values (T,) at equal intervals, in one unit; NaN where unknown.
    """
    known = [values[np.isfinite(values)] for values in curves]
    long = max((len(values) for values in known), default=0)
    if long < 2 * WINDOWS:
        return 1
    size = max(_rms(values) for values in known)
    change = max(_rms(np.diff(values)) for values in known)
    return -(-long // WINDOWS) if change > ROUGH * size else 1


def averaged(values: Array, window: int) -> Array:
    """Return means (T // window, ...) over consecutive steps."""
    whole = values[: len(values) // window * window]
    return np.asarray(whole.reshape(-1, window, *values.shape[1:]).mean(axis=1))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
