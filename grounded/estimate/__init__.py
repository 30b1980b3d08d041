"""State estimation: filter, smoother and noise of stored trials.

    smooth_trials   the smoother, or the extended Kalman filter alone, along stored trials
    noise_of        process and measurement noise by maximum likelihood

All of it works for any model (including black-box simulators), lost samples, controllers of another
rate than the sensors, and transport delays of any fraction of a step. Read `smoother`; `record`
holds its input. The linear filter is in `grounded.filter`.
"""

from __future__ import annotations

from grounded.estimate.record import Record, cut, part, record_of
from grounded.estimate.smoother import (
    Estimated,
    NoiseEstimate,
    NoiseStd,
    first_noise,
    noise_of,
    smooth_trials,
)

__all__ = [
    "Estimated",
    "NoiseEstimate",
    "NoiseStd",
    "Record",
    "cut",
    "first_noise",
    "noise_of",
    "part",
    "record_of",
    "smooth_trials",
]
