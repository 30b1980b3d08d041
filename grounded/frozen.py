"""Read-only arrays for frozen dataclasses, medians, noise and wrapped angles."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
MEDIAN = 0.6745  # median of |x| of a standard normal x
ORDERS = (2, 3, 4, 5)  # orders of differences
FLAT = 0.85  # least ratio of estimates of noise by differences of different orders, but the first
COLOURED = 1.2  # ratio of differences of every second sample and of neighbours: more is no chance
FALLS, CLEARLY, LEAST = 0.15, 1.2, 1.07  # how neighbours' estimates fall with the order, see below
SLOWER = 2.9  # the ratio of a sensor that is slower than the log
SHARED = 1.4  # the same of calm samples, which are few; they decide if they show
MOVED, HARDLY = 0.9, 1 / 3  # less than this part of the noise that all show, or of such a ratio
CALM, FEWEST = 6, 40  # samples of a command whose second half is calm; calm differences that count


def readonly(values: ArrayLike, dtype: Any = np.float64) -> Any:
    """Return a read-only, C-contiguous copy, or the array itself if it is one already."""
    array = np.asarray(values, dtype=dtype)
    if array.flags.writeable or not array.flags.c_contiguous:
        array = np.array(array, dtype=dtype, order="C")
        array.flags.writeable = False
    return array


def median(values: Array) -> Array:
    """Return the median over the first axis, like `np.median`, which imports numpy.ma (8 ms)."""
    ordered = np.sort(values, axis=0)
    middle = ordered[[(len(values) - 1) // 2, len(values) // 2]].mean(axis=0)
    return np.where(np.isnan(ordered[-1]), np.nan, middle)


def white_noise(states: Array) -> Array:
    """Estimate the standard deviation of each sensor's white noise (n,) from states (H + 1, n).

    The k-th differences of white noise have (2k)! / k!^2 times its variance, whereas those of a
    motion that is smooth over k samples vanish. So the smallest estimate of several orders contains
    the least motion. It is 0 for a state without samples.
    """
    return _seen(_by_orders(states, 1))


def calm(inputs: Array) -> Array:
    """Return which states (T + 1,) lie in the second half of a time of constant inputs (T, m)."""
    found, changes = np.zeros(len(inputs) + 1, bool), (np.diff(inputs, axis=0) != 0).any(axis=1)
    edges = np.r_[0, np.flatnonzero(changes) + 1, len(inputs)].tolist()
    for first, last in pairwise(edges):
        if last - first >= CALM:
            found[first + (last - first) // 2 + 1 : last + 1] = True
    return found


def resampled_noise(states: Array, calm: Array | None = None) -> Array:
    """Estimate the same for noise that neighbours share, as they do where a log was interpolated.

    A sample halfway between two of the sensor has half the noise of each of its neighbours, whose
    differences so show as little as 0.4 of it. Those of every second sample show all of it; they
    count where they are noise and no motion: where higher orders hardly change them, and where
    those of neighbours fall with the order. The more neighbours share, the less noise there is at
    high frequencies: if they show 0.6 or 0.4 of it, the second order has 1.3 or 1.4 times the noise
    of the fifth. A fast motion in steps, such as an aircraft's roll, has the same at all orders.
    Where `calm` samples (H + 1,) show less, or no such neighbours, these decide: after each step of
    the commands, a motion that is over within few samples has differences of all orders.
    """
    near, apart = _by_orders(states, 1), _by_orders(states, 2)
    white, found = _seen(near), _seen(apart)
    level = apart[1:].min(axis=0) > FLAT * apart[1:].max(axis=0)
    more = found / np.maximum(white, 1e-300)
    falls = near[0] > np.minimum(1 + FALLS * (more - 1), CLEARLY) * near[-1]
    falls &= (near[-1] < LEAST * white) | (more > SLOWER)
    coloured = level & falls & (more > COLOURED)
    if calm is not None and calm.any():
        rest = np.where(calm[:, None], states, np.nan)
        near, apart = _by_orders(rest, 1, FEWEST), _by_orders(rest, 2, FEWEST)
        moved = near.min(axis=0) < MOVED * white
        moved |= coloured & (apart[0] < (1 + HARDLY * (more - 1)) * near[0])
        moved &= np.isfinite(near[0]) & np.isfinite(apart[0])
        coloured = np.where(moved, apart[0] > SHARED * near[0], coloured)
        white = np.where(moved, near.min(axis=0), white)
        found = np.where(moved, apart[0], found)
    return np.where(coloured, found, white)


def _by_orders(states: Array, stride: int, fewest: int = 1) -> Array:
    """Return the noise by differences of each order of every `stride`-th sample, (orders, n).

    It is infinite by fewer than `fewest` differences that are known.
    """
    found = np.full((len(ORDERS), states.shape[1]), np.inf)
    parts, done = [np.asarray(states[k::stride]) for k in range(stride)], 0
    for row, order in zip(found, ORDERS, strict=True):
        parts, done = [np.diff(part, n=order - done, axis=0) for part in parts], order
        each = np.abs(np.concatenate(parts))
        white = MEDIAN * math.sqrt(math.comb(2 * order, order))
        if each.size and np.isfinite(each).all():
            row[:] = median(each) / white
            continue
        for j, column in enumerate(each.T):
            known = column[np.isfinite(column)]
            row[j] = median(known) / white if len(known) >= fewest else np.inf
    return found


def _seen(by_orders: Array) -> Array:
    least = by_orders.min(axis=0)
    return np.where(np.isfinite(least), least, 0.0)


def wrapped(d: Array, angles: ArrayLike) -> Array:
    """Wrap the angles (n,) bool among the first entries of `d` (..., >= n), in place; return d."""
    for i in np.asarray(angles).nonzero()[0].tolist():  # np.flatnonzero takes ten times as long
        column = d[..., i]
        column -= 2 * np.pi * np.rint(column / (2 * np.pi))
    return d
