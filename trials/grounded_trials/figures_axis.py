"""Axes: round numbers to write beside them, and where a value lies."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

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
