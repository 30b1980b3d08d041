"""Fewer points for the same picture: what is left out lies within a pixel of what is drawn.

First, of the points in one column of pixels only the first, lowest, highest and last are kept (so
that no peak is lost). Then every second point that lies on the line between its neighbours is
dropped, a few times over.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grounded.frozen import Array

PASSES, TOLERANCE = 5, 0.1  # [pixels] each

Index = NDArray[np.intp]


def thinned(x: Array, y: Array) -> Index:
    """Which points (in pixels) of a curve are enough, in order; the ends always are."""
    index = np.arange(len(x))
    if len(x) > 2 and np.all(np.diff(x) >= 0):
        index = _columns(x, y)
    for _ in range(PASSES):
        if len(index) < 3:
            break
        index = _straightened(x, y, index)
    return index


def _columns(x: Array, y: Array) -> Index:
    """First, lowest, highest and last point of each column of pixels; x must not fall."""
    column = np.floor(x).astype(int)
    order = np.lexsort((y, column))
    edges = np.flatnonzero(np.diff(column[order])) + 1
    starts, ends = np.r_[0, edges], np.r_[edges, len(x)] - 1
    turns = np.flatnonzero(np.diff(column)) + 1
    ends_of = np.r_[0, turns, turns - 1, len(x) - 1]
    return np.unique(np.concatenate([order[starts], order[ends], ends_of]))


def _straightened(x: Array, y: Array, index: Index) -> Index:
    """Drops every second point that is within the tolerance of its neighbours' line."""
    middle = np.arange(1, len(index) - 1, 2)
    a, b, c = index[middle - 1], index[middle], index[middle + 1]
    dx, dy = x[c] - x[a], y[c] - y[a]
    length = np.hypot(dx, dy)
    ex, ey = x[b] - x[a], y[b] - y[a]
    safe = np.where(length > 0, length, 1.0)
    along = (ex * dx + ey * dy) / safe
    off = np.where(length > 0, np.abs(ex * dy - ey * dx) / safe, np.hypot(ex, ey))
    inside = (along >= -TOLERANCE) & (along <= length + TOLERANCE)
    keep = np.ones(len(index), bool)
    keep[middle[(off <= TOLERANCE) & inside]] = False
    return index[keep]
