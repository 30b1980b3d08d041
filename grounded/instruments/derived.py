"""Recognise a logged velocity that was computed from the logged position by a causal filter.

Such a velocity is a weighted sum of past differences of its position, with weights that sum to 1.
The weights, fitted by least squares, give its age and the time it averages over, whatever the shape
of the filter. Such a velocity also carries the position's noise, exactly. If it is from a sensor of
its own, however late or slow, weights that fit its motion add the position's noise to it, and leave
at least that as a remainder. Two later differences get weights too. The next one may have some, as
resampling interpolates between rows; a filter knows nothing of the one after it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.frozen import Array, median, white_noise, wrapped
from grounded.instruments.kinematics import OFF, pieces
from grounded.instruments.lag import SURE
from grounded.model import Model
from grounded.places import Integral
from grounded.trial import Trial

PAST, LATER = 24, 2  # differences before and after the sample that get a weight
ENOUGH = 10  # samples per weight
FORESEEN = 0.1  # weight of the second later difference above which it is no causal filter
CARRIED = 0.5  # of the noise that the weights take from the position: a larger remainder is another
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
    dt, rows, said, seen = trials[0].dt, list[Array](), list[Array](), list[Array]()
    for piece in pieces(trials, (relation.i, relation.j)):
        moved = np.diff(piece[:, 0])[:, None]
        wrapped(moved, [model.angle_mask[relation.i]])
        if len(moved) >= PAST + LATER:
            windows = np.lib.stride_tricks.sliding_window_view(moved[:, 0] / dt, PAST + LATER)
            rows.append(windows[:, ::-1])
            said.append(relation.c * piece[PAST : PAST + len(windows), 1])
            seen.append(np.concatenate([[0.0], np.cumsum(moved)]))
    count = sum(map(len, said))
    if count < ENOUGH * (PAST + LATER):
        return None
    a, w = np.concatenate(rows), np.concatenate(said)
    weights, _, rank, _ = np.linalg.lstsq(a, w, rcond=None)
    rest = w - a @ weights
    size = float(w @ w)
    if rank < a.shape[1] or not float(rest @ rest) < UNEXPLAINED**2 * size:
        return None
    noise = float(median(np.concatenate([white_noise(q[:, None]) for q in seen])))
    passed = noise * float(np.linalg.norm(np.diff(np.pad(weights, 1)))) / dt
    if not np.sqrt(rest @ rest / count) < CARRIED * passed:
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
