"""Draws the page's figures as PNG files with matplotlib, on white."""

from __future__ import annotations

import io
import textwrap
from typing import Any

import numpy as np

from grounded.errors import needs
from grounded.figures.figure import (
    COLOURS,
    DASHES,
    FEW,
    Bars,
    Curve,
    Dot,
    Figure,
    Key,
    Panel,
    log_ticks,
    loss_ticks,
    typeset,
)

WIDE, HIGH, SQUARE = 4.8, 2.7, 4.4  # [inch] of a panel
HEAD, ROW = 0.5, 0.27  # [inch] of a title above bars, and of a bar
POSES = 6  # drawn poses of a moving body
DPI = 200
MARKERS = {"disc": "o", "ring": "o", "cross": "x", "dash": "_"}
TITLE = 52  # characters per line of a panel's title
CAPTION, PER_INCH = 8.0, 17.0  # size of a caption [pt], and its characters per inch
NOTE, NOTE_SIZE = 68, 8.0  # characters per line of a panel's note, and its size [pt]
OTHERS = 3  # largest number of single trials named in a legend
STYLE: Any = {
    "font.size": 9.0, "axes.titlesize": 9.5, "axes.titleweight": "bold",
    "axes.titlelocation": "left", "axes.grid": True, "axes.axisbelow": True,
    "grid.color": "#e3e3e3", "axes.edgecolor": "#bbbbbb",
    "axes.spines.top": False, "axes.spines.right": False, "text.parse_math": False,
    "legend.frameon": False, "figure.constrained_layout.use": True, "svg.hashsalt": "grounded",
}  # fmt: skip


def png(figure: Figure) -> bytes:
    """Return the PNG file of a figure: its title, its panels, its legend, and its caption.

    Raises:
        GroundedError: if matplotlib is not installed.
    """
    needs("matplotlib", "png")
    from matplotlib import rc_context, rcParams
    from matplotlib.figure import Figure as Sheet

    panels = figure.panels
    columns = min(3 if len(panels) > 4 else 2, max(len(panels), 1))
    rows = [panels[i : i + columns] for i in range(0, len(panels), columns)]
    heights = [max(_height(panel) for panel in row) for row in rows] or [1.0]
    with rc_context(STYLE):
        wide = max(columns, 1.6) * WIDE
        caption = textwrap.fill(figure.caption, round(wide * PER_INCH))
        below = CAPTION / 72 * 1.3 * len(caption.splitlines())
        sheet = Sheet(figsize=(wide, sum(heights) + 0.9 + below), dpi=DPI)
        sheet.suptitle(figure.title, x=0.01, ha="left", fontsize=12.0)
        grid = sheet.add_gridspec(len(heights), columns, height_ratios=heights)
        for i, row in enumerate(rows):
            for j, panel in enumerate(row):
                axes = sheet.add_subplot(grid[i, j])
                note = "" if isinstance(panel, Bars) else textwrap.fill(panel.note, NOTE)
                room = 1.2 * NOTE_SIZE * (note.count("\n") + 1) if note else 0.0
                title = typeset(textwrap.fill(panel.title, TITLE))
                axes.set_title(title, pad=rcParams["axes.titlepad"] + room)
                axes.annotate(
                    typeset(note), (0, 1), (0, 3), "axes fraction", "offset points",
                    fontsize=NOTE_SIZE, va="bottom",
                )  # fmt: skip
                if isinstance(panel, Bars):
                    _bars(axes, panel, most=round((heights[i] - HEAD) / ROW))
                else:
                    _panel(axes, panel)
        handles = [_handle(key) for key in _keys(figure)]
        if handles:
            sheet.legend(
                handles=handles, loc="outside lower left", ncols=columns + 1, alignment="left",
                title=typeset(caption) or None, title_fontsize=CAPTION,
            )  # fmt: skip
        elif caption:
            sheet.supxlabel(typeset(caption), x=0.01, ha="left", fontsize=CAPTION)
        stream = io.BytesIO()
        sheet.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def _height(panel: Panel | Bars) -> float:
    if isinstance(panel, Bars):
        return HEAD + ROW * max(len(panel.bars), 1)
    return SQUARE if panel.equal else HIGH


def _keys(figure: Figure) -> list[Key]:
    """Return the legend; many single trials become one entry."""
    single = [key for key in figure.key if key.trial]
    if len(single) <= OTHERS:
        return list(figure.key)
    kept = [key for key in figure.key if not key.trial]
    return [*kept, Key(single[0].role, f"{len(single)} other trials")]


def _bars(axes: Any, panel: Bars, most: int) -> None:
    """Draw bars as thick as those of the panel with the `most` bars in the same row."""
    rows = range(len(panel.bars))
    drawn = axes.barh(rows, panel.values, color=[_colour(bar.role) for bar in panel.bars])
    axes.bar_label(drawn, [bar.text for bar in panel.bars], padding=3)
    axes.set_yticks(rows, [bar.label for bar in panel.bars])
    axes.set_xlim(panel.ends)
    axes.set_ylim(max(most, len(rows)) - 0.5, -0.5)
    axes.xaxis.set_visible(False)
    axes.grid(False)
    axes.tick_params(left=False)
    axes.spines["bottom"].set_visible(False)


def _panel(axes: Any, panel: Panel) -> None:
    across, up = panel.ranges()
    for band in panel.bands:
        ends = [float(panel.height(v)) for v in (band.low, band.high)]
        axes.axhspan(*np.clip(ends, *up), color=_colour(band.role), alpha=0.15, lw=0)
    for rule in panel.rules:
        axes.axhline(float(panel.height(rule.y)), **_line(rule.role, 1.2))
    for curve in panel.curves:
        _curve(axes, panel, curve)
    for dot in panel.dots:
        _dot(axes, panel, dot, up)
    axes.set(xlabel=typeset(panel.x_name), ylabel=typeset(panel.y_name))
    if panel.log:
        axes.set(xscale="log", yscale="log")
        for axis, span in ((axes.xaxis, across), (axes.yaxis, up)):
            ticks = log_ticks(*span)
            axis.set_ticks(ticks, [f"{v:g}" for v in ticks])
            axis.set_ticks([], minor=True)
        across, up = ((10.0**low, 10.0**high) for low, high in (across, up))
    axes.set_xlim(across, auto=panel.equal)
    axes.set_ylim(up, auto=panel.equal)
    if panel.equal:
        axes.set_aspect("equal", adjustable="datalim")
    if panel.whole:
        from matplotlib.ticker import MaxNLocator

        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if panel.x_ticks:
        axes.set_xticks(*zip(*panel.x_ticks, strict=True))
    if panel.loss:
        ticks = loss_ticks(*up)
        axes.set_yticks(panel.height(np.array(ticks)), [f"{v:g}" for v in ticks])


def _curve(axes: Any, panel: Panel, curve: Curve) -> None:
    y = curve.y if panel.log else panel.height(curve.y)
    if curve.style == "ghost":
        return
    if curve.style == "points":
        few = len(curve.x) <= FEW
        look: dict[str, Any] = {"ms": 5.0, "alpha": 0.7} if few else {"ms": 2.5, "alpha": 0.4}
        look |= {"ms": 9.0} if panel.log else {}
        axes.plot(curve.x, y, ".", color=_colour(curve.role), mew=0, **look)
        return
    how = "steps-post" if curve.style == "steps" else "default"
    dots = {"marker": ".", "ms": 7.0} if panel.log else {}
    axes.plot(curve.x, y, drawstyle=how, **_line(curve.role, curve.width), **dots)
    if curve.motion is not None and curve.trial and curve.role != "other":
        for row in np.linspace(0, len(curve.motion.times) - 1, POSES).astype(int):
            for line, thick in curve.motion.lines(row):
                width = 4.0 if thick else 1.0
                axes.plot(*line.T, color=_colour(curve.role), lw=width, alpha=0.25)
    if curve.shade is not None:
        drawn = axes.scatter(curve.x, y, c=curve.shade, s=9, cmap="cividis", zorder=3)
        axes.figure.colorbar(drawn, ax=axes, label=curve.shade_name, shrink=0.8)


def _dot(axes: Any, panel: Panel, dot: Dot, up: tuple[float, float]) -> None:
    height, colour = float(panel.height(dot.y)), _colour(dot.role)
    if not np.isfinite(height):
        height = up[0] + 0.04 * (up[1] - up[0])
    elif dot.error > 0:
        ends = [float(panel.height(dot.y + sign * dot.error)) for sign in (-1, 1)]
        axes.plot([dot.x, dot.x], ends, color=colour, lw=1.2)
    axes.plot(dot.x, height, **_mark(dot.shape, colour), clip_on=False)


def _mark(shape: str, colour: str) -> dict[str, Any]:
    inside = "none" if shape == "ring" else colour
    size = 9 if shape == "dash" else 6
    look = {"marker": MARKERS[shape], "ms": size, "mfc": inside, "mec": colour, "mew": 1.6}
    return look | {"ls": "none"}


def _line(role: str, width: float) -> dict[str, Any]:
    dash = DASHES.get(role)
    style = (0, tuple(v / max(width, 1.0) for v in dash)) if dash else "-"
    return {"color": _colour(role), "lw": width * 0.8, "ls": style}


def _handle(key: Key) -> Any:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    if key.shape == "band":
        return Patch(color=_colour(key.role), alpha=0.3, lw=0, label=key.name)
    if key.shape in MARKERS:
        return Line2D([], [], label=key.name, **_mark(key.shape, _colour(key.role)))
    return Line2D([], [], label=key.name, **_line(key.role, 2.0))


def _colour(role: str) -> str:
    return COLOURS[role][0]
