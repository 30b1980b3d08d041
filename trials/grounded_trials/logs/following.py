"""Compare a rate with the derivative of a position: correlation, scale and unit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grounded_trials.formats.messages import Floats

SAME, DEGREE = 0.15, 180 / np.pi
SPAN = 5  # samples over which a slope is taken


@dataclass(frozen=True)
class Follows:
    """Correlation of two signals, and how many times as large the second is."""

    correlation: float
    slope: float


def follows(q: Floats, w: Floats, step: float) -> Follows:
    """Compare w with the derivative of q, both averaged over a few samples.

    Args:
        q: (N,) position.
        w: (N,) rate.
        step: sample time [s].
    """
    slope = (q[SPAN:] - q[:-SPAN]) / (SPAN * step)
    mean = np.convolve(0.5 * (w[1:] + w[:-1]), np.ones(SPAN) / SPAN, "valid")
    good = np.isfinite(slope) & np.isfinite(mean)
    a, b = slope[good], mean[good]
    if len(a) < 20 or a.std() < 1e-9 or b.std() < 1e-9:
        return Follows(0.0, 1.0)
    a, b = a - a.mean(), b - b.mean()
    return Follows(float(a @ b / np.sqrt((a @ a) * (b @ b))), float(a @ b / (a @ a)))


def scale_of(slope: float) -> tuple[float, str]:
    """Return the factor that a rate must be multiplied by, and a phrase on sign and unit."""
    sign, size = np.sign(slope), abs(slope)
    opposite = " with the OPPOSITE SIGN" if sign < 0 else ""
    if abs(size / DEGREE - 1) < SAME:
        return float(sign / DEGREE), f"{opposite}, in DEGREES per second"
    if abs(size * DEGREE - 1) < SAME:
        return float(sign * DEGREE), f"{opposite}, whose values are in DEGREES"
    return float(sign), opposite
