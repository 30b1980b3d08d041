"""Whether a velocity's log is off by a constant: the way that its position went says so.

Over a stretch of T seconds a mean velocity is the way over the time, whatever the physics is:

    mean of c y_w  -  (y_q(T) - y_q(0)) / T  =  c b + k (y_q(T) - y_q(0)) / T + noise

for a constant b of the velocity's sensor and a scale k of either. Both are fitted over stretches of
all trials, whose scatter about the line is their uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.frozen import wrapped
from grounded.instruments.kinematics import Integral, pieces
from grounded.model import Model
from grounded.trial import Trial

STRETCHES = 24  # of all trials, at least
SHORTEST = 4  # steps of one
SURE = 5.0  # standard deviations of a constant that is found
NONE = 3.0  # of one that may be none
LARGE = 0.01  # of the velocity's rms: a constant that is stated
FINE = 0.02  # of that: what SURE standard deviations must be below to say that there is none


@dataclass(frozen=True)
class Constant:
    """By how much a velocity's log is more than its position's rate, and beside what.

    Args:
        value: in the velocity's unit.
        std: its standard deviation.
        rms: of the velocity.
    """

    value: float
    std: float
    rms: float

    @property
    def found(self) -> bool:
        """Whether something is there, and matters."""
        return abs(self.value) > max(SURE * self.std, LARGE * self.rms)

    @property
    def refuted(self) -> bool:
        """Whether nothing is there, as far as these trials tell, and they would tell."""
        return abs(self.value) < NONE * self.std and SURE * self.std < FINE * self.rms


def constant_of(model: Model, relation: Integral, trials: Sequence[Trial]) -> Constant | None:
    """What a velocity's log is off by, beside its position's; None where too little was seen."""
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
