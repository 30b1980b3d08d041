"""Draws the page's figures as PNG files: matplotlib draws Plotly's traces, on white."""

from __future__ import annotations

import io
import textwrap
from typing import Any

from grounded.errors import needs
from grounded.figures import PALETTE, Figure, Key, Panel, Trace, key_trace, typeset

WIDE, HIGH, SQUARE = 4.8, 2.7, 4.4  # [inch] of a panel
DPI = 200
MARKERS = {"circle": "o", "circle-open": "o", "x-thin": "x", "line-ew": "_"}
LINE, MARK = 0.8, 0.7  # points of a pixel of a line's width, and of a mark's size
TITLE, NOTE = 52, 68  # characters per line of a panel's title and note
SMALL = 8.0  # size of captions and notes [pt]
PER_INCH = 17.0  # characters of a caption
OTHERS = 3  # largest number of single trials named in a legend
STYLE: Any = {
    "font.size": 9.0, "axes.titlesize": 9.5, "axes.titleweight": "bold",
    "axes.titlelocation": "left", "axes.grid": True, "axes.axisbelow": True,
    "grid.color": "#e3e3e3", "axes.edgecolor": "#bbbbbb",
    "axes.spines.top": False, "axes.spines.right": False, "text.parse_math": False,
    "legend.frameon": False, "figure.constrained_layout.use": True,
}  # fmt: skip


def png(figure: Figure, columns: int = 0, size: tuple[float, float] = (WIDE, HIGH)) -> bytes:
    """Return the PNG file of a figure: its title, its panels, its legend, and its caption.

    Raises:
        GroundedError: if matplotlib is not installed.
    """
    needs("matplotlib", "png")
    from matplotlib import rc_context
    from matplotlib.figure import Figure as Sheet
    from matplotlib.lines import Line2D

    panels = figure.panels
    columns = columns or min(3 if len(panels) > 4 else 2, max(len(panels), 1))
    rows = [panels[i : i + columns] for i in range(0, len(panels), columns)]
    square = [any("scaleanchor" in panel.layout["yaxis"] for panel in row) for row in rows]
    heights = [SQUARE if one else size[1] for one in square] or [1.0]
    with rc_context(STYLE):
        wide = max(columns, 1.6) * size[0]
        caption = typeset(textwrap.fill(figure.caption, round(wide * PER_INCH)))
        below = SMALL / 72 * 1.3 * len(caption.splitlines())
        sheet = Sheet(figsize=(wide, sum(heights) + 0.9 + below), dpi=DPI)
        sheet.suptitle(figure.title, x=0.01, ha="left", fontsize=12.0)
        grid = sheet.add_gridspec(len(heights), columns, height_ratios=heights)
        for i, row in enumerate(rows):
            for j, panel in enumerate(row):
                _draw(sheet.add_subplot(grid[i, j]), panel)
        handles = [Line2D([], [], label=key.name, **_look(key_trace(key))) for key in _keys(figure)]
        if handles:
            sheet.legend(
                handles=handles, loc="outside lower left", ncols=columns + 1, alignment="left",
                title=caption or None, title_fontsize=SMALL,
            )  # fmt: skip
        elif caption:
            sheet.supxlabel(caption, x=0.01, ha="left", fontsize=SMALL)
        stream = io.BytesIO()
        sheet.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def _keys(figure: Figure) -> list[Key]:
    """Return the legend; many single trials become one entry."""
    single = [key for key in figure.key if key.trial]
    if len(single) <= OTHERS:
        return list(figure.key)
    kept = [key for key in figure.key if not key.trial]
    return [*kept, Key(single[0].role, f"{len(single)} other trials")]


def _draw(axes: Any, panel: Panel) -> None:
    """Draw a panel."""
    # the title, and the note between it and the axes
    note = typeset(textwrap.fill(panel.note, NOTE))
    room = 1.2 * SMALL * (note.count("\n") + 1) if note else 0.0
    axes.set_title(typeset(textwrap.fill(panel.title, TITLE)), pad=6.0 + room)
    axes.annotate(
        note, (0, 1), (0, 3), "axes fraction", "offset points", fontsize=SMALL, va="bottom"
    )

    # the contents
    layout = panel.layout
    for shape in layout.get("shapes", ()):
        if shape["type"] == "rect":
            axes.axhspan(shape["y0"], shape["y1"], color=_colour(shape["fillcolor"]), lw=0)
        else:
            axes.axhline(shape["y0"], **_look(shape))
    for trace in panel.data:
        if trace.get("visible", True):
            _trace(axes, trace)

    # the axes
    equal = "scaleanchor" in layout["yaxis"]
    for name in ("x", "y"):
        _axis(axes, name, layout[f"{name}axis"], grows=equal)
    if equal:
        axes.set_aspect("equal", adjustable="datalim")


def _axis(axes: Any, name: str, axis: dict[str, Any], grows: bool) -> None:
    """Set the range (that `grows` if needed), the ticks and the title of an axis."""
    set_ticks, ends = getattr(axes, f"set_{name}ticks"), axis.get("range", ())
    if axis.get("type") == "log":
        getattr(axes, f"set_{name}scale")("log")
        set_ticks([], minor=True)
        ends = [10.0**end for end in ends]
    if "tickvals" in axis:
        set_ticks(axis["tickvals"], [text.replace("<br>", "\n") for text in axis["ticktext"]])
    if ends:
        getattr(axes, f"set_{name}lim")(ends, auto=grows)
    if "title" in axis:
        getattr(axes, f"set_{name}label")(typeset(axis["title"]["text"]))


def _trace(axes: Any, trace: Trace) -> None:
    """Draw a line or marks, with their errors."""
    x, y = trace["x"], trace["y"]
    if error := trace.get("error_y"):
        look = {"ecolor": _colour(error["color"]), "elinewidth": 1.2}
        axes.errorbar(x, y, error["array"], fmt="none", **look)
    axes.plot(x, y, clip_on=trace.get("cliponaxis", True), **_look(trace))


def _look(trace: Trace) -> dict[str, Any]:
    """Return the look of a trace, of a legend's entry or of a rule for matplotlib."""
    mode, line, marker = trace.get("mode", "lines"), trace.get("line", {}), trace.get("marker", {})
    look: dict[str, Any] = {"ls": "none"}
    if "lines" in mode:
        width = max(line["width"], 1.0)
        dash = [float(part.strip("px")) / width for part in line.get("dash", "").split(",") if part]
        look = {"color": _colour(line["color"]), "lw": LINE * line["width"]}
        look["ls"] = (0, tuple(dash)) if dash else "-"
        look["drawstyle"] = "steps-post" if line.get("shape") == "hv" else "default"
    if "markers" in mode and not marker:
        look |= {"marker": ".", "ms": 7.0}
    elif "markers" in mode:
        colour, symbol = _colour(marker["color"]), marker.get("symbol", "circle")
        edge = marker.get("line", {}).get("width", 0.0)
        look |= {"marker": MARKERS[symbol], "ms": MARK * marker["size"], "mec": colour}
        look |= {"mfc": "none" if symbol.endswith("open") else colour, "mew": edge}
    return look


def _colour(role: str) -> tuple[float, ...]:
    """Return the colour on white of a role, such as "@best" or "@best/0.15"."""
    from matplotlib.colors import to_rgba

    name, _, opacity = role[1:].partition("/")
    return to_rgba(PALETTE[name][0], float(opacity or 1))
