"""State estimation: the states of a record, and how much the model is disturbed.

    smoothed        the smoother, or the extended Kalman filter alone, along records
    process_noise   the noise of the process, by maximum likelihood

All of it works for any model (including black-box simulators), lost samples, controllers of another
rate than the sensors, and transport delays of any fraction of a step. Read `smoother`; `record`
holds its input. The linear filter is in `grounded.filter`.
"""

from __future__ import annotations

from grounded.estimate.record import Record, batch_of, cut, part, record_of
from grounded.estimate.smoother import Estimated, NoiseStd, first_noise, process_noise, smoothed

__all__ = [
    "Estimated",
    "NoiseStd",
    "Record",
    "batch_of",
    "cut",
    "first_noise",
    "part",
    "process_noise",
    "record_of",
    "smoothed",
]
