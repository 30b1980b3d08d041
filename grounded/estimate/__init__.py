"""State estimation: filter, smoother, likelihood and noise.

    smooth_trials   the smoother, or the extended Kalman filter alone, along stored trials
    noise_of        process and measurement noise by maximum likelihood

All of it works for any model (including black-box simulators), lost
samples, sensors and controllers of different rates, and transport delays of any fraction of a step.

Read `trials` first (the public functions), then `measurement` and `record` (their input),
`extended` (the Kalman filter along a track) with `steps` (the model in it), `likelihood` (the
noise). The linear filter is in `grounded.filter`.
"""

from __future__ import annotations

from grounded.estimate.likelihood import NoiseEstimate
from grounded.estimate.measurement import Measurement, NoiseStd, of_states
from grounded.estimate.record import Record, cut, record_of
from grounded.estimate.trials import (
    Estimated,
    noise_of,
    smooth_trials,
)

__all__ = [
    "Estimated",
    "Measurement",
    "NoiseEstimate",
    "NoiseStd",
    "Record",
    "cut",
    "noise_of",
    "of_states",
    "record_of",
    "smooth_trials",
]
