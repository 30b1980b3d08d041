"""Detect a constant bias of a logged velocity by comparing it with its position.

Over a stretch of T seconds the mean velocity is the distance over the time, whatever the physics:

    mean of c y_w  -  (y_q(T) - y_q(0)) / T  =  c b + k (y_q(T) - y_q(0)) / T + noise

with a bias b of the velocity's sensor and a scale error k of either sensor. Both are fitted over
stretches of all trials; the scatter about the line gives their uncertainty.

The rate of a heading may differ in proportion to the speed instead: two wheels of unequal size turn
a vehicle that their encoders see going straight. At rest such a difference is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.frozen import Array, wrapped
from grounded.instruments.kinematics import pieces
from grounded.model import Model
from grounded.places import Integral, heading, speed
from grounded.trial import Trial

STRETCHES = 24  # least number of stretches over all trials
SHORTEST = 4  # steps in the shortest stretch
SURE = 5.0  # standard deviations above which a bias is found
NONE = 3.0  # standard deviations below which it may be zero
BETTER = 0.5  # share of the squares that a constant leaves, below which the speed explains more
LARGE = 0.01  # of the velocity's rms: the smallest bias reported
FINE = 0.02  # of the velocity's rms: SURE standard deviations must be below it to rule a bias out


@dataclass(frozen=True)
class Constant:
    """The bias of a logged velocity against the rate of its position.

    Args:
        value: the bias, in the velocity's unit; positive if the velocity is too large.
        std: its standard deviation.
        rms: rms of the velocity itself.
        pull: the difference per unit of the speed, if that explains it better; 0 if not.
    """

    value: float
    std: float
    rms: float
    pull: float = 0.0

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
    rows, whole = _stretches(model, relation, trials)
    if len(rows) < STRETCHES // 2:
        return None
    off, rates, counts = np.array(rows).T[:3]
    fitted, left, inverse = _line(off, [np.ones_like(rates), rates], counts)
    variance = left / (len(rows) - 2) * float(inverse[0, 0])
    rms = float(np.sqrt(np.mean(np.concatenate([piece[:, 1] for piece in whole]) ** 2)))
    std = variance**0.5 / abs(relation.c)
    found = Constant(float(fitted[0]) / relation.c, std, rms)
    driven = speed(model)
    if not found.found or model.state_names[relation.i] != heading(model) or driven is None:
        return found
    also, _ = _stretches(model, relation, trials, model.state_names.index(driven))
    if len(also) < len(rows):
        return found
    off, rates, counts, speeds = np.array(also).T
    along, less, _ = _line(off, [speeds, rates], counts)
    return replace(found, pull=float(along[0]) / relation.c if less < BETTER * left else 0.0)


def _line(off: Array, columns: Sequence[Array], counts: Array) -> tuple[Array, float, Array]:
    """Return a weighted fit of the columns, the sum of squares that it leaves, and its inverse."""
    design = np.stack(columns, axis=1)
    square = design.T @ (counts[:, None] * design)
    inverse = np.asarray(np.linalg.pinv(square, hermitian=True), np.float64)
    fitted = inverse @ (design.T @ (counts * off))
    return fitted, float(counts @ (off - design @ fitted) ** 2), inverse


def _stretches(
    model: Model, relation: Integral, trials: Sequence[Trial], beside: int | None = None
) -> tuple[list[tuple[float, ...]], list[Array]]:
    """Return the difference, the position's rate and the steps of each stretch, and all pieces.

    Args:
        model: with the angles among the states.
        relation: the position and its velocity.
        trials: of one time step.
        beside: another state, whose mean over each stretch is appended.
    """
    columns = (relation.i, relation.j, *(() if beside is None else (beside,)))
    dt, whole = trials[0].dt, list(pieces(trials, columns))
    steps = sum(len(piece) - 1 for piece in whole)
    rows: list[tuple[float, ...]] = []
    for piece in whole:
        moved = np.diff(piece[:, 0])[:, None]
        wrapped(moved, [model.angle_mask[relation.i]])
        rate, w = moved[:, 0] / dt, relation.c * 0.5 * (piece[1:, 1] + piece[:-1, 1])
        parts = max(1, min(-(-STRETCHES * len(rate) // steps), len(rate) // SHORTEST))
        for some in np.array_split(np.arange(len(rate)), parts):
            row = float((w - rate)[some].mean()), float(rate[some].mean()), float(len(some))
            rows.append((*row, *piece[:-1, 2:][some].mean(axis=0)))
    return rows, whole
