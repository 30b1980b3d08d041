"""Recognise a logged velocity that was computed from the logged position by a causal filter.

Such a velocity is a weighted sum of past differences of its position, with weights that sum to 1.
The weights, fitted by least squares, give its age and the time it averages over, whatever the shape
of the filter. The velocity then also carries the position's noise: the weights hold for second
differences of both, in which noise prevails. For a separate sensor they only fit the motion. Two
later differences get weights too. The next one may have some, as resampling interpolates between
rows; a filter knows nothing of the one after it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.frozen import Array, wrapped
from grounded.instruments.kinematics import OFF, Integral, pieces
from grounded.instruments.lag import SURE
from grounded.model import Model
from grounded.trial import Trial

PAST, LATER = 8, 2  # differences before and after the sample that get a weight
ENOUGH = 10  # samples per weight
FORESEEN = 0.1  # weight of the second later difference above which it is no causal filter
BESIDE, LEAST = 1.1, 0.05  # the best fit to second differences, above which the weights don't hold
UNEXPLAINED = 0.2  # of the velocity's size: a larger remainder comes from another sensor


@dataclass(frozen=True)
class Derived:
    """The weights of past differences of a position in a velocity, summarised.

    Args:
        gain: their sum.
        gain_std: its standard deviation.
        age: their mean age [s].
        over: length of the plain mean with the same variance of ages [s].
    """

    gain: float
    gain_std: float
    age: float
    over: float


def derived(
    model: Model, relation: Integral, trials: Sequence[Trial], least: float
) -> Derived | None:
    """Return how a velocity follows from its position through a causal filter.

    Args:
        model: with this relation.
        relation: the position and the velocity.
        trials: of this model's states.
        least: time over which it must certainly average [s].

    Returns:
        None if it has another scale, is not explained by the position's past, or averages less.
    """
    dt, rows, said = trials[0].dt, list[Array](), list[Array]()
    for piece in pieces(trials, (relation.i, relation.j)):
        moved = np.diff(piece[:, 0])[:, None]
        wrapped(moved, [model.angle_mask[relation.i]])
        if len(moved) >= PAST + LATER:
            windows = np.lib.stride_tricks.sliding_window_view(moved[:, 0] / dt, PAST + LATER)
            rows.append(windows[:, ::-1])
            said.append(relation.c * piece[PAST : PAST + len(windows), 1])
    count = sum(map(len, said))
    if count < ENOUGH * (PAST + LATER):
        return None
    a, w = np.concatenate(rows), np.concatenate(said)
    weights, _, rank, _ = np.linalg.lstsq(a, w, rcond=None)
    rest = w - a @ weights
    size = float(w @ w)
    if rank < a.shape[1] or not float(rest @ rest) < UNEXPLAINED**2 * size:
        return None
    if not _carries_noise(rows, said, weights):
        return None
    covariance = np.linalg.inv(a.T @ a) * float(rest @ rest) / count
    gain = float(weights.sum())
    if abs(gain - 1) > OFF or abs(float(weights[0])) > FORESEEN:
        return None
    ages = (np.arange(PAST + LATER) - LATER + 0.5) * dt
    age = float(weights @ ages) / gain
    apart = (ages - age) ** 2 + dt**2 / 12  # each difference is itself a mean over a step
    wide = 12 * float(weights @ apart)
    std = 12 * float(np.sqrt(apart @ covariance @ apart))
    if wide - SURE * std < least**2:
        return None
    return Derived(gain, float(np.sqrt(covariance.sum())), age, float(np.sqrt(wide)))


def _carries_noise(rows: Sequence[Array], said: Sequence[Array], weights: Array) -> bool:
    """Check whether the weights explain second differences about as well as the best ones do."""
    a = np.concatenate([np.diff(x, 2, axis=0) for x in rows])
    w = np.concatenate([np.diff(x, 2) for x in said])
    own = np.linalg.lstsq(a, w, rcond=None)[0]
    best, size = (float(np.linalg.norm(x)) for x in (w - a @ own, w))
    return float(np.linalg.norm(w - a @ weights)) < BESIDE * best + LEAST * size
