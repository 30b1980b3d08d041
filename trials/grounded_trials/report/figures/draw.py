"""From a panel to shapes at places, in pixels from the top left, and from shapes to SVG.

The shapes are the one layout of all outputs. In SVG colours go by class, so that a page decides
light or dark, and lengths are whole tenths of a pixel. Lines carry their name, and the plot what
its axes mean, in data- attributes: that is all that hovering needs.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np

from grounded.frozen import Array
from grounded_trials.report.figures.axis import Axis, fitted, thinned
from grounded_trials.report.figures.figure import Band, Bars, Curve, Dot, Panel

WIDTH, HEIGHT, SQUARE = 460.0, 220.0, 420.0
LEFT, RIGHT, TOP, BOTTOM = 56.0, 10.0, 26.0, 36.0
ROW, LETTER = 24.0, 6.9  # of bars; the mean width of a letter
LONGEST = 24  # letters of a label
FAINT = 0.15  # opacity of a band
TENTHS = 10


@dataclass(frozen=True, eq=False)
class Stroke:
    """A line through points (k, 2)."""

    points: Array
    role: str
    width: float = 1.0
    name: str = ""
    times: Array | None = None


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
        axes, names = (self.x, self.y), (panel.x_name, panel.y_name)
        size = (WIDTH, self.height)
        return Drawing(panel.title, *size, tuple(shapes), self.box, *axes, names, panel.equal)

    def _points(self, x: Array, y: Array) -> Array:
        left, top, width, height = self.box
        return np.column_stack(
            [left + width * self.x.place(x), top + height * (1 - self.y.place(y))]
        )

    def _grid(self) -> list[Shape]:
        left, top, width, height = self.box
        shapes: list[Shape] = []
        bottom, panel = top + height, self.panel
        for value, text in self.y.ticks(7 if panel.equal else 5):
            at = top + height * (1 - float(self.y.place(value)))
            ends = np.array([[left, at], [left + width, at]])
            shapes += [Stroke(ends, "grid"), Words(left - 6, at + 4, text, "end", "faint")]
        for value, text in self.x.ticks(7):
            if panel.whole and (value < 1 or value != round(value)):
                continue
            at = left + width * float(self.x.place(value))
            ends, text = (
                np.array([[at, top], [at, bottom]]),
                f"{value:.0f}" if panel.whole else text,
            )
            shapes += [Stroke(ends, "grid"), Words(at, bottom + 15, text, "middle", "faint")]
        shapes.append(Words(left + width / 2, bottom + 31, panel.x_name, "middle", "faint"))
        shapes.append(Words(12, top + height / 2, panel.y_name, "middle", "faint", turned=True))
        return shapes

    def _band(self, band: Band) -> Shape:
        left, top, width, height = self.box
        first, last = np.clip(self.y.place(np.array([band.low, band.high])), 0.0, 1.0)
        y, high = float(top + height * (1 - last)), float(height * (last - first))
        return Box(left, y, width, high, band.role, FAINT, band.note)

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
        half, up = size / 2, size / 2 / aspect
        return Axis(x_mid - half, x_mid + half), Axis(y_mid - up, y_mid + up)
    return Axis(x_low, x_high), Axis(y_low, y_high)


def _bars(panel: Bars) -> Drawing:
    height = TOP + ROW * max(len(panel.bars), 1) + 8
    shapes: list[Shape] = [Words(8, 16, panel.title, role="title")]
    most = max((abs(b.value) for b in panel.bars if np.isfinite(b.value)), default=0.0) or 1.0
    longest = max((min(len(b.label), LONGEST) for b in panel.bars), default=0)
    left = 16 + LETTER * longest
    room = max(WIDTH - left - 12 - LETTER * max((len(b.text) for b in panel.bars), default=0), 40.0)
    for i, bar in enumerate(panel.bars):
        label = bar.label if len(bar.label) <= LONGEST else bar.label[: LONGEST - 1] + "…"
        y, note = TOP + ROW * i, f"{bar.label}: {bar.text}"
        size = room * max(bar.value, 0.0) / most if np.isfinite(bar.value) else 0.0
        shapes.append(Words(left - 6, y + 15, label, "end", "faint"))
        shapes.append(Box(left, y + 4, max(size, 1.0), ROW - 9, bar.role, 1.0, note))
        shapes.append(Words(left + size + 6, y + 15, bar.text))
    return Drawing(panel.title, WIDTH, height, tuple(shapes))


def svg(drawing: Drawing, identity: str) -> str:
    """The <svg> element; `identity` is unique in its page."""
    width, height = _t(drawing.width), _t(drawing.height)
    data = _hover(drawing) if drawing.x is not None else ""
    body = "".join(_shape(shape, identity) for shape in drawing.shapes)
    x, y, w, h = (_t(v) for v in drawing.box)
    clip = f'<clipPath id="{identity}"><rect x="{x}" y="{y}" width="{w}" height="{h}"/></clipPath>'
    label = escape(drawing.title)
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{label}"{data}>'
        f"{clip if w else ''}{body}</svg>"
    )


def _hover(drawing: Drawing) -> str:
    assert drawing.x is not None and drawing.y is not None
    box = " ".join(str(_t(v)) for v in drawing.box)
    ends = (drawing.x.low, drawing.x.high, drawing.y.low, drawing.y.high)
    ranges = " ".join(repr(float(f"{v:.7g}")) for v in ends)
    names = "|".join(name.replace("|", "/") for name in drawing.names)
    kind = "path" if drawing.path else "loss" if drawing.y.loss else "time"
    return (
        f' class="plot" data-box="{box}" data-axes="{ranges}" data-names="{escape(names)}" '
        f'data-kind="{kind}"'
    )


def _shape(shape: Shape, identity: str) -> str:
    if isinstance(shape, Stroke):
        return _stroke(shape, identity)
    if isinstance(shape, Words):
        turn = f' transform="rotate(-90 {_t(shape.x)} {_t(shape.y)})"' if shape.turned else ""
        return (
            f'<text class="{shape.role} {shape.anchor}" x="{_t(shape.x)}" y="{_t(shape.y)}"{turn}>'
            f"{escape(shape.text)}</text>"
        )
    if isinstance(shape, Box):
        note = f' data-note="{escape(shape.note)}"' if shape.note else ""
        opacity = f' fill-opacity="{shape.opacity:g}"' if shape.opacity < 1 else ""
        return (
            f'<rect class="{shape.role} fill" x="{_t(shape.x)}" y="{_t(shape.y)}" '
            f'width="{_t(shape.width)}" height="{_t(shape.height)}"{opacity}{note}/>'
        )
    return _spot(shape)


def _stroke(stroke: Stroke, identity: str) -> str:
    points = np.rint(stroke.points * TENTHS).astype(int)
    if stroke.role == "grid":
        (a, b), (c, d) = points
        return f'<path class="grid" d="M{a} {b}L{c} {d}"/>'
    steps = np.diff(points, axis=0)
    moves = " ".join(f"{dx} {dy}" for dx, dy in steps.tolist()).replace(" -", "-")
    start = f"M{points[0, 0]} {points[0, 1]}"
    named = f' data-name="{escape(stroke.name)}"' if stroke.name else ""
    if stroke.times is not None and stroke.name:
        ticks = np.diff(np.rint(stroke.times * 100).astype(int), prepend=0)
        named += f' data-t="{" ".join(map(str, ticks.tolist()))}"'
    thick = f' stroke-width="{_t(stroke.width)}"'
    line = f"l{moves}" if len(steps) else "h1"
    return (
        f'<path class="{stroke.role} line" clip-path="url(#{identity})" '
        f'd="{start}{line}"{thick}{named}/>'
    )


def _spot(spot: Spot) -> str:
    note = f' data-note="{escape(spot.note)}" tabindex="0"' if spot.note else ""
    x, y = _t(spot.x), _t(spot.y)
    if spot.shape in ("disc", "ring"):
        kind = "fill" if spot.shape == "disc" else "hollow"
        return f'<circle class="{spot.role} {kind}" cx="{x}" cy="{y}" r="45"{note}/>'
    if spot.shape == "cross":
        mark = f"M{x - 45} {y - 45}l90 90m0-90l-90 90"
    else:
        mark = f"M{x - 60} {y}h120"
    return f'<path class="{spot.role} line whole" stroke-width="20" d="{mark}"{note}/>'


def _t(value: float) -> int:
    return round(value * TENTHS)
