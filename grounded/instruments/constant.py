"""Detect a constant bias of a logged velocity by comparing it with its position.

Over a stretch of T seconds the mean velocity is the distance over the time, whatever the physics:

    mean of c y_w  -  (y_q(T) - y_q(0)) / T  =  c b + k (y_q(T) - y_q(0)) / T + noise

with a bias b of the velocity's sensor and a scale error k of either sensor. Both are fitted over
stretches of all trials; the scatter about the line gives their uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.frozen import wrapped
from grounded.instruments.kinematics import pieces
from grounded.model import Model
from grounded.places import Integral
from grounded.trial import Trial

STRETCHES = 24  # least number of stretches over all trials
SHORTEST = 4  # steps in the shortest stretch
SURE = 5.0  # standard deviations above which a bias is found
NONE = 3.0  # standard deviations below which it may be zero
LARGE = 0.01  # of the velocity's rms: the smallest bias reported
FINE = 0.02  # of the velocity's rms: SURE standard deviations must be below it to rule a bias out


@dataclass(frozen=True)
class Constant:
    """The bias of a logged velocity against the rate of its position.

    Args:
        value: the bias, in the velocity's unit; positive if the velocity is too large.
        std: its standard deviation.
        rms: rms of the velocity itself.
    """

    value: float
    std: float
    rms: float

    @property
    def found(self) -> bool:
        """Whether the bias is significant and large enough to report."""
        return abs(self.value) > max(SURE * self.std, LARGE * self.rms)

    @property
    def refuted(self) -> bool:
        """Whether the trials rule a bias out: none is seen, and one would have been."""
        return abs(self.value) < NONE * self.std and SURE * self.std < FINE * self.rms


def constant_of(model: Model, relation: Integral, trials: Sequence[Trial]) -> Constant | None:
    """Return the bias of a logged velocity against its position; None with too little data."""
    dt, whole = trials[0].dt, list(pieces(trials, (relation.i, relation.j)))
    steps = sum(len(piece) - 1 for piece in whole)
    rows: list[tuple[float, float, int]] = []
    for piece in whole:
        moved = np.diff(piece[:, 0])[:, None]
        wrapped(moved, [model.angle_mask[relation.i]])
        rate, w = moved[:, 0] / dt, relation.c * 0.5 * (piece[1:, 1] + piece[:-1, 1])
        parts = max(1, min(-(-STRETCHES * len(rate) // steps), len(rate) // SHORTEST))
        for some in np.array_split(np.arange(len(rate)), parts):
            rows.append((float((w - rate)[some].mean()), float(rate[some].mean()), len(some)))
    if len(rows) < STRETCHES // 2:
        return None
    off, rates, counts = np.array(rows).T
    columns = np.stack([np.ones_like(rates), rates], axis=1)
    inverse = np.linalg.pinv(columns.T @ (counts[:, None] * columns), hermitian=True)
    fitted = inverse @ (columns.T @ (counts * off))
    left = off - columns @ fitted
    variance = float(counts @ left**2) / (len(rows) - 2) * float(inverse[0, 0])
    rms = float(np.sqrt(np.mean(np.concatenate([piece[:, 1] for piece in whole]) ** 2)))
    return Constant(float(fitted[0]) / relation.c, variance**0.5 / abs(relation.c), rms)
