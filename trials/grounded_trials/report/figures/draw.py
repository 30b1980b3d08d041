"""From a panel to shapes at places, in pixels from the top left: the one layout of all outputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grounded.frozen import Array
from grounded_trials.report.figures.axis import Axis, fitted, thinned
from grounded_trials.report.figures.figure import Band, Bars, Curve, Dot, Panel

WIDTH, HEIGHT, SQUARE = 460.0, 220.0, 420.0
LEFT, RIGHT, TOP, BOTTOM = 56.0, 10.0, 26.0, 36.0
ROW, LETTER = 24.0, 6.9  # of bars; the mean width of a letter
LONGEST = 24  # letters of a label


@dataclass(frozen=True, eq=False)
class Stroke:
    """A line through points (k, 2)."""

    points: Array
    role: str
    width: float = 1.0
    name: str = ""
    times: Array | None = None
    clip: bool = True


@dataclass(frozen=True)
class Words:
    """A text; anchor start, middle or end; turned: it reads upwards."""

    x: float
    y: float
    text: str
    anchor: str = "start"
    role: str = "text"  # text, title, faint
    turned: bool = False


@dataclass(frozen=True)
class Box:
    """A filled rectangle."""

    x: float
    y: float
    width: float
    height: float
    role: str
    opacity: float = 1.0
    note: str = ""


@dataclass(frozen=True)
class Spot:
    """A point mark."""

    x: float
    y: float
    role: str
    shape: str
    note: str


Shape = Stroke | Words | Box | Spot


@dataclass(frozen=True, eq=False)
class Drawing:
    """A panel's size, its shapes, the plot's box and what its axes mean (for hovering)."""

    title: str
    width: float
    height: float
    shapes: tuple[Shape, ...]
    box: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # x, y, width, height
    x: Axis | None = None
    y: Axis | None = None
    names: tuple[str, str] = ("", "")
    path: bool = False  # hover by the nearest point, not by x


def draw(panel: Panel | Bars) -> Drawing:
    """The shapes of a panel."""
    return _bars(panel) if isinstance(panel, Bars) else _Plot(panel).drawing()


class _Plot:
    """A panel while it is laid out."""

    def __init__(self, panel: Panel) -> None:
        self.panel = panel
        self.height = SQUARE if panel.equal else HEIGHT
        self.box = (LEFT, TOP, WIDTH - LEFT - RIGHT, self.height - TOP - BOTTOM)
        self.x, self.y = _axes(panel, self.box[2] / self.box[3])

    def drawing(self) -> Drawing:
        panel = self.panel
        shapes: list[Shape] = [Words(LEFT, 16, panel.title, role="title")]
        shapes += [self._band(band) for band in panel.bands]
        shapes += self._grid()
        for rule in panel.rules:
            ends = self._points(np.array([self.x.low, self.x.high]), np.full(2, rule.y))
            shapes.append(Stroke(ends, rule.role, 1.2, rule.name))
        for curve in panel.curves:
            shapes += self._curve(curve)
        for dot in panel.dots:
            shapes += self._dot(dot)
        if panel.note:
            shapes.append(Words(WIDTH - RIGHT - 4, TOP + 12, panel.note, "end", "faint"))
        names = (panel.x_name, panel.y_name)
        tops = tuple(shapes)
        return Drawing(
            panel.title, WIDTH, self.height, tops, self.box, self.x, self.y, names, panel.equal
        )

    def _points(self, x: Array, y: Array) -> Array:
        left, top, width, height = self.box
        return np.column_stack(
            [left + width * self.x.place(x), top + height * (1 - self.y.place(y))]
        )

    def _grid(self) -> list[Shape]:
        left, top, width, height = self.box
        shapes: list[Shape] = []
        for value, text in self.y.ticks(7 if self.panel.equal else 5):
            at = float(self._points(np.array([self.x.low]), np.array([value]))[0, 1])
            ends = np.array([[left, at], [left + width, at]])
            shapes += [Stroke(ends, "grid"), Words(left - 6, at + 4, text, "end", "faint")]
        for value, text in self.x.ticks(7):
            if self.panel.whole:
                if value < 1 or value != round(value):
                    continue
                text = f"{value:.0f}"
            at = float(self._points(np.array([value]), np.array([self.y.high]))[0, 0])
            ends = np.array([[at, top], [at, top + height]])
            shapes += [Stroke(ends, "grid"), Words(at, top + height + 15, text, "middle", "faint")]
        shapes.append(
            Words(left + width / 2, top + height + 31, self.panel.x_name, "middle", "faint")
        )
        shapes.append(
            Words(12, top + height / 2, self.panel.y_name, "middle", "faint", turned=True)
        )
        return shapes

    def _band(self, band: Band) -> Shape:
        left, top, width, height = self.box
        ends = np.array([band.low, band.high])
        axis = self.x if band.vertical else self.y
        first, last = np.clip(axis.place(ends), 0.0, 1.0)
        if band.vertical:
            area = (left + width * first, top, width * (last - first), height)
        else:
            area = (left, top + height * (1 - last), width, height * (last - first))
        x, y, w, h = map(float, area)
        return Box(x, y, w, h, band.role, band.opacity, band.note)

    def _curve(self, curve: Curve) -> list[Shape]:
        points = self._points(curve.x, curve.y)
        good = np.isfinite(points).all(axis=1)
        edges = np.flatnonzero(np.diff(np.r_[False, good, False].astype(int)))
        shapes: list[Shape] = []
        for first, last in edges.reshape(-1, 2):
            part = np.clip(points[first:last], -2000.0, 4000.0)
            index = thinned(part[:, 0], part[:, 1])
            times = None if curve.times is None else curve.times[first:last][index]
            shapes.append(Stroke(part[index], curve.role, curve.width, curve.name, times))
        return shapes

    def _dot(self, dot: Dot) -> list[Shape]:
        _, top, _, height = self.box
        x, y = self._points(np.array([dot.x]), np.array([dot.y]))[0]
        failed = not np.isfinite(y)
        y = top + height - 6 if failed else min(max(y, top), top + height)
        shapes: list[Shape] = []
        if dot.error > 0 and not failed:
            ends = np.array([dot.y - dot.error, dot.y + dot.error])
            shapes.append(Stroke(self._points(np.full(2, dot.x), ends), dot.role, 1.2))
        shapes.append(Spot(float(x), float(y), dot.role, dot.shape, dot.note))
        return shapes


def _axes(panel: Panel, aspect: float) -> tuple[Axis, Axis]:
    """Ranges that hold all that is drawn; for equal scales the shorter one is widened."""
    seen = [c for c in panel.curves if c.name] or list(panel.curves)
    xs = [c.x for c in seen] + [np.array([d.x for d in panel.dots])]
    ys = [c.y for c in seen] + [np.array([d.y for d in panel.dots])]
    ys.append(np.array([rule.y for rule in panel.rules]))
    x_low, x_high = fitted(xs, 0.06 if panel.equal else 0.03 if panel.dots else 0.0)
    if panel.whole:
        x_low, x_high = x_low - 0.6, x_high + 0.6
    y_low, y_high = panel.y_range or fitted(ys)
    if panel.loss:
        values = np.concatenate(ys)
        values = values[np.isfinite(values)]
        low, high = float(values.min()), float(values.max())
        room = (low / high) ** 0.08 if low != high else 1.1
        return Axis(x_low, x_high), Axis(low * room, high / room, loss=True)
    if panel.equal:
        size = max(x_high - x_low, (y_high - y_low) * aspect)
        x_mid, y_mid = (x_low + x_high) / 2, (y_low + y_high) / 2
        half = size / 2
        return (
            Axis(x_mid - half, x_mid + half),
            Axis(y_mid - half / aspect, y_mid + half / aspect),
        )
    return Axis(x_low, x_high), Axis(y_low, y_high)


def _bars(panel: Bars) -> Drawing:
    height = TOP + ROW * max(len(panel.bars), 1) + 8
    shapes: list[Shape] = [Words(8, 16, panel.title, role="title")]
    most = max((abs(b.value) for b in panel.bars if np.isfinite(b.value)), default=0.0) or 1.0
    labels = [
        b.label if len(b.label) <= LONGEST else b.label[: LONGEST - 1] + "…" for b in panel.bars
    ]
    left = 16 + LETTER * max((len(label) for label in labels), default=0)
    room = max(WIDTH - left - 12 - LETTER * max((len(b.text) for b in panel.bars), default=0), 40.0)
    for i, (bar, label) in enumerate(zip(panel.bars, labels, strict=True)):
        y = TOP + ROW * i
        size = room * max(bar.value, 0.0) / most if np.isfinite(bar.value) else 0.0
        note = f"{bar.label}: {bar.text}"
        shapes.append(Words(left - 6, y + 15, label, "end", "faint"))
        shapes.append(Box(left, y + 4, max(size, 1.0), ROW - 9, bar.role, 1.0, note))
        shapes.append(Words(left + size + 6, y + 15, bar.text))
    return Drawing(panel.title, WIDTH, height, tuple(shapes))
