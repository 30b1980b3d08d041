"""What the prediction error is made of: explained, unexplained, irreducible.

    mean e^2 of the crude model  =  explained    what the diagnosis takes away on held-out trials
                                 +  unexplained  what it leaves above the noise
                                 +  irreducible  the noise floor: no model predicts it

All three are read off the `ruler`.
"""

from __future__ import annotations

import numpy as np

from grounded.diagnosis.error_report import ChannelParts, Parts, Split
from grounded.frozen import Array


def shares(before: Array, after: Array, floor: Array) -> Array:
    """explained, unexplained, irreducible: the shares of each mean squared error, (3, ...).

    Args:
        before: of the crude model.
        after: as diagnosed.
        floor: what no model predicts.
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
    """The parts of the error at one horizon.

    Args:
        horizon_s: how far ahead [s].
        units: of the channels, in order.
        before: rms error of the crude model (n,).
        after: as diagnosed (n,).
        floor: of noise alone (n,); NaN where it is not known.
        source: what the floor is from.
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
