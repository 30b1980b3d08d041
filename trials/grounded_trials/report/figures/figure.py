"""Figures as plain values: what is drawn, before it is known how.

A figure is a title, a caption and panels; a panel has axes and what lies in them. `draw.py` turns
a panel into shapes at places and into SVG, `png.py` makes PNG files of them: a page and a
picture show the same. Colours are roles ("best", "desired"): a page follows the reader's light or
dark.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from grounded.frozen import Array

# Okabe & Ito (2008), told apart by colour-blind people too: role -> (on white, on black)
COLOURS = {
    "desired": ("#000000", "#ffffff"),
    "real": ("#000000", "#ffffff"),
    "model": ("#d55e00", "#d55e00"),
    "best": ("#0072b2", "#56b4e9"),
    "predicted": ("#cc79a7", "#cc79a7"),
    "limit": ("#b47c00", "#e69f00"),
    "accepted": ("#009e73", "#009e73"),
    "other": ("#9a9a9a", "#7d7d7d"),
    "step1": ("#009e73", "#009e73"),
    "step2": ("#e69f00", "#f0e442"),
    "step3": ("#9a9a9a", "#8d8d8d"),
}
STEPS = ("step1", "step2", "step3")  # roles of iterations, in order
WIDTHS = {"best": 2.5, "desired": 1.0}  # of paths; 1.5 for the other roles
DASHES = {"desired": (6.0, 3.0), "predicted": (2.0, 2.0), "limit": (8.0, 2.0, 2.0, 2.0)}


def rgb(colour: str) -> tuple[int, int, int]:
    """Red, green and blue of "#rrggbb"."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


@dataclass(frozen=True, eq=False)
class Curve:
    """A line through points; NaN breaks it. Faint ones are context, without a name."""

    x: Array
    y: Array
    role: str
    name: str = ""
    width: float = 1.5
    times: Array | None = None  # [s] of each point of a path, for hovering


@dataclass(frozen=True)
class Dot:
    """A point with what hovering says of it."""

    x: float
    y: float
    role: str
    note: str
    shape: str = "disc"  # disc, ring, cross, dash
    error: float = 0.0  # half the height of an error bar


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
    """Axes with curves and marks. `loss`: y by the logarithm of its distance from 0."""

    title: str
    x_name: str
    y_name: str
    curves: tuple[Curve, ...] = ()
    dots: tuple[Dot, ...] = ()
    rules: tuple[Rule, ...] = ()
    bands: tuple[Band, ...] = ()
    equal: bool = False  # one scale for both axes
    loss: bool = False
    whole: bool = False  # x counts
    y_range: tuple[float, float] | None = None
    note: str = ""  # inside, top right


@dataclass(frozen=True)
class Bar:
    """A horizontal bar with its label, and what stands behind it."""

    label: str
    value: float
    text: str
    role: str = "best"


@dataclass(frozen=True)
class Bars:
    """Horizontal bars from zero, one below the other."""

    title: str
    bars: tuple[Bar, ...]


@dataclass(frozen=True)
class Key:
    """An entry of a figure's legend."""

    role: str
    name: str
    shape: str = "line"


@dataclass(frozen=True, eq=False)
class Figure:
    """Panels that belong together, with one legend; `name` is its file's."""

    name: str
    title: str
    caption: str
    panels: tuple[Panel | Bars, ...]
    key: tuple[Key, ...] = ()


def legend(panels: Sequence[Panel | Bars]) -> tuple[Key, ...]:
    """What the named curves, rules and bands of panels are, each once."""
    found: dict[tuple[str, str], Key] = {}
    for panel in panels:
        if isinstance(panel, Bars):
            continue
        named = [(c.role, c.name) for c in panel.curves] + [(r.role, r.name) for r in panel.rules]
        for role, name in named:
            if name:
                found.setdefault((role, name), Key(role, name))
    return tuple(found.values())
