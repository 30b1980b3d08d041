"""A drawing as SVG: colours by class, so that a page decides light or dark; numbers kept short.

Lengths are tenths of a pixel and whole. Lines carry their name, and the plot what its axes mean,
in data- attributes: that is all that hovering needs.
"""

from __future__ import annotations

from html import escape

import numpy as np

from grounded_trials.report.figures.draw import Box, Drawing, Shape, Spot, Stroke, Words

TENTHS = 10


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
    ranges = " ".join(
        repr(float(f"{v:.7g}"))
        for v in (drawing.x.low, drawing.x.high, drawing.y.low, drawing.y.high)
    )
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
