"""Axes and curves in pixels: ranges that hold the data, round numbers beside them, fewer points.

A curve is thinned so that what is left out lies within a pixel of what is drawn. First, of the
points in one column of pixels only the first, lowest, highest and last are kept (so that no peak
is lost). Then every second point that lies on the line between its neighbours is dropped, a few
times over.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grounded.frozen import Array

FAR = 1e4  # ranges outside the axis, where everything looks alike
LEAST = 1e-12  # a range below which differences are rounding


@dataclass(frozen=True)
class Axis:
    """A range; `loss` spaces negative numbers by the logarithm of their size, 0 far up."""

    low: float
    high: float
    loss: bool = False

    def place(self, value: float | Array) -> Array:
        """0 at the low end, 1 at the high end."""
        a, b = self._scaled(self.low), self._scaled(self.high)
        return np.asarray(np.clip((self._scaled(value) - a) / (b - a), -FAR, FAR))

    def _scaled(self, value: float | Array) -> Array:
        value = np.asarray(value, float)
        if not self.loss:
            return value
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(-np.log10(-np.minimum(value, self.high)))

    def ticks(self, most: int = 5) -> list[tuple[float, str]]:
        """Round numbers inside the range, as values and as text."""
        if self.loss:
            return _loss_ticks(self.low, self.high, most)
        span = self.high - self.low
        step = round_up(span / most)
        first = math.ceil(self.low / step - 1e-9)
        count = math.floor(self.high / step + 1e-9) - first + 1
        decimals = max(0, -math.floor(math.log10(step) + 1e-9))
        values = [(first + i) * step for i in range(count)]
        return [(v, _text(v, decimals, step)) for v in values]


def _text(value: float, decimals: int, step: float) -> str:
    if abs(value) >= 1e5 or decimals > 5:
        digits = math.log10(max(abs(value), step) / step)
        return f"{value:.{max(2, math.ceil(digits - 1e-9) + 1)}g}".replace("-", "−")
    text = f"{value:.{decimals}f}"
    return text.replace("-", "−") if float(text) else f"{0:.{decimals}f}"


def round_up(step: float) -> float:
    """The next of 1, 2, 5, 10, 20 ... that is not smaller."""
    power = 10.0 ** math.floor(math.log10(step))
    return next(f * power for f in (1, 2, 5, 10) if f * power >= step * (1 - 1e-9))


def _loss_ticks(low: float, high: float, most: int) -> list[tuple[float, str]]:
    """-1, -2, -5, -10 ... , or fewer of them, or round steps where the range is short."""
    powers = range(math.floor(math.log10(-high)) - 1, math.ceil(math.log10(-low)) + 1)
    for factors in ((1, 1.5, 2, 3, 5, 7), (1, 2, 5), (1, 3), (1,)):
        values = [-f * 10.0**k for k in powers for f in factors]
        values = [v for v in values if low <= v <= high]
        if len(values) <= most:
            break
    if len(values) < 2:
        return Axis(low, high).ticks(most)
    return [(v, f"{v:g}".replace("-", "−")) for v in sorted(values)]


def fitted(values: Iterable[Array], margin: float = 0.06) -> tuple[float, float]:
    """A range around finite values, with some room."""
    kept = [v[np.isfinite(v)] for v in values]
    kept = [v for v in kept if len(v)]
    if not kept:
        return 0.0, 1.0
    low, high = min(float(v.min()) for v in kept), max(float(v.max()) for v in kept)
    size = max(abs(low), abs(high))
    span = high - low if high - low > 1e-9 * size else 0.0
    room = margin * span if span > LEAST else max(0.05 * size, LEAST)
    return low - room, high + room


def without_astray(kept: list[Array], more: list[Array], most: float = 3.0) -> list[Array]:
    """`kept`, and of `more` what does not leave their range by more than `most` times its size.

    A first run that crashed must not flatten the picture of those that did not.
    """
    low, high = fitted(kept, 0.0)
    span = (high - low) * most
    inside = [np.where((v >= low - span) & (v <= high + span), v, np.nan) for v in more]
    return [*kept, *inside]


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
