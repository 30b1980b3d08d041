"""Split of the mean squared prediction error into explained, unexplained and irreducible parts.

    mean e^2 of the crude model  =  explained    what the diagnosis removes on held-out trials
                                 +  unexplained  what it leaves above the noise
                                 +  irreducible  the noise floor, which no model predicts

All three come from the errors of the `ruler`.
"""

from __future__ import annotations

import numpy as np

from grounded.diagnosis.error_report import ChannelParts, Parts, Split
from grounded.frozen import Array


def shares(before: Array, after: Array, floor: Array) -> Array:
    """Return the explained, unexplained and irreducible shares of mean squared errors, (3, ...).

    Args:
        before: mean squared errors of the crude model.
        after: those of the diagnosed model.
        floor: those of noise alone.
    """
    after = np.minimum(after, before)
    floor = np.minimum(floor, after)
    return np.stack([before - after, after - floor, floor]) / np.maximum(before, 1e-300)


def split(
    horizon_s: float,
    units: dict[str, str],
    before: Array,
    after: Array,
    floor: Array,
    source: str,
    unsure: float = 0.0,
) -> Split:
    """Return the parts of the error at one horizon.

    Args:
        horizon_s: how far ahead [s].
        units: {channel: unit}, in order.
        before: rms error of the crude model (n,).
        after: rms error of the diagnosed model (n,).
        floor: rms error of noise alone (n,); NaN where it is not known.
        source: how the floor was determined.
        unsure: standard deviation of the floor's logarithm.
    """
    unknown = np.isnan(floor) & ~np.isnan(before)
    squares = [np.nan_to_num(rms) ** 2 for rms in (before, after, floor)]
    each = shares(*squares)
    each[1:, unknown] = np.nan
    unit = squares[0] if unknown.any() else squares[2]  # of each state's errors
    scale = 1 / np.maximum(unit, 1e-9 * np.maximum(squares[0], 1e-300))
    whole = shares(*(np.asarray((scale * part).sum()) for part in squares))
    whole[1:] += np.nan if unknown.any() else 0.0
    channels = tuple(
        ChannelParts(name, unit, float(np.nan_to_num(before[i])), *map(float, each[:, i]))
        for i, (name, unit) in enumerate(units.items())
    )
    return Split(horizon_s, Parts(*map(float, whole)), channels, source, unsure)
