"""Figures as plain values, independent of the library that draws them.

A figure has a title, a caption and panels; a panel has axes, curves and marks. Plotly draws them in
a page and a notebook, matplotlib in a picture. Colours are roles ("best", "desired"), so that a
page follows the reader's light or dark mode.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grounded.figures.body import Motion
from grounded.frozen import Array

# Okabe & Ito (2008), distinguishable with colour blindness: role -> (on white, on black)
COLOURS = {
    "desired": ("#000000", "#ffffff"),
    "real": ("#000000", "#ffffff"),
    "model": ("#d55e00", "#d55e00"),
    "best": ("#0072b2", "#56b4e9"),
    "predicted": ("#cc79a7", "#cc79a7"),
    "limit": ("#b47c00", "#e69f00"),
    "accepted": ("#009e73", "#009e73"),
    "other": ("#7a7a7a", "#7d7d7d"),
    "step1": ("#009e73", "#009e73"),
    "step2": ("#b47c00", "#f0e442"),
    "step3": ("#6f6f6f", "#8d8d8d"),
}
STEPS = ("step1", "step2", "step3")  # roles of iterations, in order
WIDTHS = {"best": 2.5, "desired": 1.0}  # line widths of paths; 1.5 for the other roles
DASHES = {
    "desired": (6.0, 3.0),
    "predicted": (2.0, 2.0),
    "limit": (8.0, 2.0, 2.0, 2.0),
    "step2": (5.0, 2.0),
}
TYPESET = {"^2": "²", "^3": "³", "->": "→", "+-": "±"}
SMALLEST_RANGE = 1e-12  # range below which differences are rounding errors
LARGE_DOTS = 300  # most dots that are drawn large
LETTER = 0.045  # width of a letter of a bar's text, as a share of the longest bar
FACTORS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)  # factors by which deviations may be enlarged


def typeset(value: Any) -> Any:
    """Replace plain notation by typographic signs; values other than plain str are unchanged."""
    if type(value) is str:
        for plain, sign in TYPESET.items():
            value = value.replace(plain, sign)
    return value


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue of "#rrggbb"."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


@dataclass(frozen=True, eq=False)
class Curve:
    """A line through points; NaN breaks it. Curves for context have no name.

    times: time of each point of a path [s].
    shade: a value for each point, shown as its colour; `shade_name` is its name.
    trial: the trial whose path it is, so that an animation finds a trial's parts.
    motion: the body that moves along the path.
    """

    x: Array
    y: Array
    role: str
    name: str = ""
    width: float = 1.5
    times: Array | None = None
    shade: Array | None = None
    shade_name: str = ""
    trial: str = ""
    style: str = "line"  # line, steps (each y holds until the next x), points,
    # or ghost: not drawn, only used by the animation
    motion: Motion | None = None
    note: str = ""  # text shown before y on hovering

    def spread(self, axis: int) -> list[Array]:
        """Return the values that must fit on the x axis (0) or the y axis (1)."""
        moved = [] if self.motion is None else [self.motion.reached[:, axis]]
        return [(self.x, self.y)[axis], *moved]


@dataclass(frozen=True)
class Dot:
    """A point with the text shown on hovering."""

    x: float
    y: float
    role: str
    note: str
    shape: str = "disc"  # disc, ring, cross, dash
    error: float = 0.0  # half the height of an error bar
    trial: str = ""


@dataclass(frozen=True)
class Rule:
    """A horizontal line across the panel."""

    y: float
    role: str
    name: str


@dataclass(frozen=True)
class Band:
    """A faint horizontal band across the panel."""

    low: float
    high: float
    role: str
    note: str


@dataclass(frozen=True, eq=False)
class Panel:
    """Axes with curves and marks.

    loss: the y axis is logarithmic in -y.
    log: both axes are logarithmic.
    """

    title: str
    x_name: str
    y_name: str
    curves: tuple[Curve, ...] = ()
    dots: tuple[Dot, ...] = ()
    rules: tuple[Rule, ...] = ()
    bands: tuple[Band, ...] = ()
    equal: bool = False  # equal scales on both axes
    loss: bool = False
    log: bool = False
    whole: bool = False  # x values are whole numbers
    x_ticks: tuple[tuple[float, str], ...] = ()  # positions and labels of ticks; () for automatic
    y_range: tuple[float, float] | None = None
    note: str = ""  # text inside, top right
    kind: str = ""  # time: x is the time of a run; path: positions of a run

    def height(self, y: float | Array) -> Array:
        """Return the position of a value on the y axis: y, log10(y), or -log10(-y) of a loss."""
        y = np.asarray(y, float)
        if self.log:
            return _log10(y)
        if not self.loss:
            return y
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(-np.log10(-np.minimum(y, self._largest)))

    @property
    def _largest(self) -> float:
        known = [v[np.isfinite(v) & (v < 0)] for v in self._heights()]
        return max((float(v.max()) for v in known if len(v)), default=-1.0)

    def _heights(self) -> list[Array]:
        marks = [d.y for d in self.dots] + [rule.y for rule in self.rules]
        return [*(y for c in self._seen for y in c.spread(1)), np.array(marks)]

    @property
    def _seen(self) -> list[Curve]:
        named = [c for c in self.curves if c.name] or list(self.curves)
        return [c for c in named if c.style != "ghost"]

    def ranges(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the ranges of x and of y (as `height`) that contain everything with a name."""
        xs = [_log10(x) if self.log else x for c in self._seen for x in c.spread(0)] + [
            np.array([d.x for d in self.dots])
        ]
        margin = 0.06 if self.equal else 0.03 if self.dots or self.kind != "time" else 0.0
        low, high = fitted(xs, margin)
        if self.whole:
            low, high = low - 0.6, high + 0.6
        ends = self.y_range or fitted([self.height(v) for v in self._heights()])
        return (low, high), ends


@dataclass(frozen=True)
class Bar:
    """A horizontal bar with its label and the text behind it."""

    label: str
    value: float
    text: str
    role: str = "best"


@dataclass(frozen=True)
class Bars:
    """Horizontal bars from zero, one below the other."""

    title: str
    bars: tuple[Bar, ...]

    @property
    def values(self) -> Array:
        """Length of each bar."""
        return np.array([bar.value if np.isfinite(bar.value) else 0.0 for bar in self.bars])

    @property
    def ends(self) -> tuple[float, float]:
        """Range of the axis, with room for the bars and the text behind each."""
        most = float(np.abs(self.values).max(initial=0.0)) or 1.0
        room = np.array([most * (0.05 + LETTER * len(bar.text)) for bar in self.bars])
        ends = self.values + np.where(self.values < 0, -room, room)
        return float(ends.min(initial=0.0)), float(ends.max(initial=0.0)) or most


@dataclass(frozen=True)
class Key:
    """An entry of a figure's legend; `trial` is set for the path of a trial of role "other"."""

    role: str
    name: str
    shape: str = "line"
    trial: str = ""


@dataclass(frozen=True, eq=False)
class Figure:
    """Panels that belong together, with one legend; `name` is the name of its file."""

    name: str
    title: str
    caption: str
    panels: tuple[Panel | Bars, ...]
    key: tuple[Key, ...] = ()


def _log10(values: Array) -> Array:
    """Return log10; NaN for values without a logarithm."""
    return np.log10(np.where(values > 0, values, np.nan))


def legend(panels: Sequence[Panel | Bars]) -> tuple[Key, ...]:
    """Return a legend entry for each named curve and rule of the panels, without duplicates."""
    found: dict[tuple[str, str], Key] = {}
    for panel in panels:
        if isinstance(panel, Bars):
            continue
        for c in panel.curves:
            if c.name and c.style != "ghost":
                shape = "disc" if c.style == "points" else "line"
                trial = c.trial if c.role == "other" else ""
                found.setdefault((c.role, c.name), Key(c.role, c.name, shape, trial))
        for rule in panel.rules:
            found.setdefault((rule.role, rule.name), Key(rule.role, rule.name))
    return tuple(found.values())


def fitted(values: Iterable[Array], margin: float = 0.06) -> tuple[float, float]:
    """Return a range around the finite values, with a margin."""
    kept = [v[np.isfinite(v)] for v in values]
    kept = [v for v in kept if len(v)]
    if not kept:
        return 0.0, 1.0
    low, high = min(float(v.min()) for v in kept), max(float(v.max()) for v in kept)
    size = max(abs(low), abs(high))
    span = high - low if high - low > 1e-9 * size else 0.0
    room = margin * span if span > SMALLEST_RANGE else max(0.05 * size, SMALLEST_RANGE)
    return low - room, high + room


def without_astray(kept: list[Array], more: list[Array], most: float = 3.0) -> list[Array]:
    """Return `kept`, and `more` with values far outside the range of `kept` set to NaN.

    Far is more than `most` times the size of the range. So a crashed first run does not flatten
    the picture of the others.
    """
    low, high = fitted(kept, 0.0)
    span = (high - low) * most
    inside = [np.where((v >= low - span) & (v <= high + span), v, np.nan) for v in more]
    return [*kept, *inside]


def loss_ticks(low: float, high: float, most: int = 5) -> list[float]:
    """Return ticks for an axis of losses with `height` from low to high: -1, -2, -5, -10 ..."""
    powers = range(math.floor(-high) - 1, math.ceil(-low) + 2)
    for factors in ((1, 1.5, 2, 3, 5, 7), (1, 2, 5), (1, 3), (1,)):
        values = [-f * 10.0**k for k in powers for f in factors]
        values = [v for v in values if low <= -math.log10(-v) <= high]
        if len(values) <= most:
            break
    if len(values) > most + 2:  # many powers of ten: every second, third ... of them
        values = values[:: -(-len(values) // most)]
    if len(values) < 2:
        values = [float(f"{-(10.0**-v):.2g}") for v in np.linspace(low, high, 4)]
    return sorted(values)


def log_ticks(low: float, high: float) -> list[float]:
    """Return ticks for an axis of values from 10^low to 10^high: 1, 2, 5, 10 ..."""
    return sorted(-loss for loss in loss_ticks(-high, -low))


def enlarging(path: Array, desired: Array) -> float:
    """Return a round factor that makes the deviation of a path (T, 2) from the desired visible."""
    off = np.abs(path - desired[: len(path)])[:, :2]
    off = off[np.isfinite(off)]
    room = 0.2 * np.ptp(desired[:, :2], axis=0).max()
    return max((f for f in FACTORS if len(off) and f * off.max() <= room), default=1.0)


def thinned(x: Array, y: Array, most: int) -> NDArray[np.intp]:
    """Return indices of at most about `most` points that represent the curve, in order.

    If x ascends, these are the first, lowest, highest and last point of each column, so that no
    peak is lost; otherwise the points are thinned evenly.
    """
    count = len(x)
    if count <= most:
        return np.arange(count)
    if not np.all(np.diff(x) >= 0):
        return np.unique(np.linspace(0, count - 1, most).astype(int))
    column = np.minimum(np.arange(count) * (most // 4) // count, most // 4 - 1)
    known = np.isfinite(y)
    order = np.lexsort((np.where(known, y, -np.inf), column))
    edges = np.flatnonzero(np.diff(column)) + 1
    starts, ends = np.r_[0, edges], np.r_[edges, count] - 1
    breaks = np.flatnonzero(np.diff(known))
    return np.unique(np.concatenate([starts, ends, order[starts], order[ends], breaks, breaks + 1]))
