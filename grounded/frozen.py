"""Arrays: read-only ones for frozen dataclasses, differences of angles, medians."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grounded.errors import GroundedError

Array = NDArray[np.float64]


def readonly(values: ArrayLike, dtype: Any = np.float64) -> Any:
    """A read-only, C-contiguous copy; the same array when it is one already."""
    array = np.asarray(values, dtype=dtype)
    if array.flags.writeable or not array.flags.c_contiguous:
        array = np.array(array, dtype=dtype, order="C")
        array.flags.writeable = False
    return array


def numbers(values: Any, what: str) -> Any:
    """The same of what a user gave.

    Raises:
        GroundedError: if it isn't an array of numbers; the sentence begins with `what`.
    """
    try:
        return readonly(values)
    except (TypeError, ValueError):
        raise GroundedError(f"{what}: expected an array of numbers, got {values!r:.80}") from None


def positive(what: str, value: Any) -> None:
    """Checks a number that a user gave.

    Raises:
        GroundedError: if it isn't a positive, finite number; the sentence begins with `what`.
    """
    if not isinstance(value, (int, float, np.number)) or not (np.isfinite(value) and value > 0):
        raise GroundedError(f"{what} must be a positive number of seconds, got {value!r:.60}")


def median(values: Array) -> Array:
    """The median over the first axis, as `np.median`'s, which imports numpy.ma: 8 ms."""
    ordered = np.sort(values, axis=0)
    middle = ordered[[(len(values) - 1) // 2, len(values) // 2]].mean(axis=0)
    return np.where(np.isnan(ordered[-1]), np.nan, middle)


def wrapped(d: Array, angles: ArrayLike) -> Array:
    """`d` (..., >= n) with the angles among its first n entries wrapped to [-pi, pi], in place.

    Args:
        d: differences.
        angles: (n,) of bool.
    """
    for i in np.flatnonzero(angles):
        d[..., i] -= 2 * np.pi * np.rint(d[..., i] / (2 * np.pi))
    return d
