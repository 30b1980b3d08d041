"""Figures for Plotly: `plotted` for a page, `notebook_figure` for a notebook.

Colours are written as roles ("@best", or "@best/0.15" with an opacity), which `coloured` or the
page's script replaces by colours for light or dark mode. Building the values does not need Plotly.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from grounded.errors import needs
from grounded.figures.figure import (
    COLOURS,
    DASHES,
    LARGE_DOTS,
    Bars,
    Curve,
    Dot,
    Figure,
    Key,
    Panel,
    log_ticks,
    loss_ticks,
    rgb,
    thinned,
)
from grounded.frozen import Array

LABEL_LETTERS = 26  # most letters in a line of a bar's label
MOST_POINTS = 1600  # most points of a curve
CONTEXT = 300  # most points of a curve that is only context
STEPS = 65535  # steps in the range of a packed number
COARSE = 50.0  # ratio of the range to that of nearly all values above which two bytes are too few
FAINT = 0.15  # opacity of a band
PAPER = {
    "text": ("#1a1a1a", "#e8e8e8"),
    "grid": ("#e3e3e3", "#31363b"),
    "paper": ("#ffffff", "#16181b"),
    "near": ("#00224e", "#4a7cc0"),  # a shade from least to most: Cividis, lighter on black
    "middle": ("#7c7b78", "#a8a69c"),
    "far": ("#fee838", "#fee838"),
}
SHADES = [[0.0, "@near"], [0.5, "@middle"], [1.0, "@far"]]
LETTER, WIDE = 0.008, 7  # width of a letter: share of a figure, and [px]
SPACE = 100  # between rows [px]
SYMBOLS = {"disc": "circle", "ring": "circle-open", "cross": "x-thin", "dash": "line-ew"}


def plotted(panel: Panel | Bars, axis: str = "") -> dict[str, Any]:
    """Return a panel as Plotly's data and layout, in plain values and arrays.

    Args:
        panel: the panel.
        axis: number of its axes if several panels share a figure: "", "2", "3" ...
    """
    if isinstance(panel, Bars):
        return _bars(panel, axis)
    data = [_curve(panel, curve) for curve in panel.curves]
    looks: dict[tuple[Any, ...], list[Dot]] = {}
    for dot in panel.dots:
        looks.setdefault((dot.role, dot.shape, dot.error > 0, dot.trial), []).append(dot)
    data += [_dots(panel, same) for same in looks.values()]
    for trace in data:
        trace |= {"xaxis": f"x{axis}", "yaxis": f"y{axis}"}
    (left, right), (low, high) = panel.ranges()
    across: dict[str, Any] = {"title": {"text": panel.x_name}, "range": [left, right]}
    up: dict[str, Any] = {"title": {"text": panel.y_name}, "range": [low, high]}
    if panel.whole:
        across |= {"tickformat": "d", "dtick": max(1, round((right - left) / 8))}
    if panel.log:
        for each in (across, up):
            ticks = log_ticks(*each["range"])
            each |= {"type": "log", "tickvals": ticks, "ticktext": [f"{v:g}" for v in ticks]}
    if panel.x_ticks:
        at, labels = zip(*panel.x_ticks, strict=True)
        lines = [label.replace("\n", "<br>") for label in labels]
        across |= {"tickvals": list(at), "ticktext": lines, "ticklabeloverflow": "allow"}
    if panel.equal:
        up |= {"scaleanchor": f"x{axis}"}
    if panel.loss:
        ticks = loss_ticks(low, high)
        up |= {"tickvals": panel.height(np.array(ticks)), "ticktext": [f"{v:g}" for v in ticks]}
    layout: dict[str, Any] = {f"xaxis{axis}": _ruled(across), f"yaxis{axis}": _ruled(up)}
    layout["shapes"] = [_line(panel, rule.y, rule.role, axis) for rule in panel.rules]
    layout["shapes"] += [
        _flat(panel, band.low, band.high, axis) | {"fillcolor": f"@{band.role}/{FAINT}"}
        for band in panel.bands
    ]
    return {"data": data, "layout": layout}


def _ruled(axis: dict[str, Any]) -> dict[str, Any]:
    return axis | {
        "gridcolor": "@grid",
        "zeroline": False,
        "linecolor": "@grid",
        "automargin": True,
        "title": axis["title"] | {"standoff": 6},
    }


def _curve(panel: Panel, curve: Curve) -> dict[str, Any]:
    near = curve.name and curve.role != "other" and curve.style != "ghost"
    most = MOST_POINTS if near else CONTEXT
    index = thinned(curve.x, curve.y, most)
    trace: dict[str, Any] = {
        "type": "scatter", "mode": "lines", "x": curve.x[index], "y": panel.height(curve.y[index]),
        "name": curve.name, "line": {"color": f"@{curve.role}", "width": curve.width},
        "meta": {"role": curve.role, "trial": curve.trial, "style": curve.style},
        "hovertemplate": "%{y:.5g}",
    }  # fmt: skip
    if panel.log:
        known = curve.y > 0
        x, y = (values[known].tolist() for values in (curve.x, curve.y))
        trace |= {"x": x, "y": y, "mode": "lines+markers"}
    if curve.note:
        trace["hovertemplate"] = f"{curve.note}: {trace['hovertemplate']}"
    trace["line"] |= _dash(curve.role)
    if curve.times is not None:
        trace["customdata"] = curve.times[index]
        trace["hovertemplate"] = "%{customdata:.2f} s: (%{x:.4g}, %{y:.4g})"
    if not curve.name:
        trace |= {"hoverinfo": "skip", "hovertemplate": ""}
    if curve.style == "points":
        look = ("0.7", 6) if len(curve.x) <= LARGE_DOTS else ("0.4", 4)
        trace |= {"mode": "markers", "marker": {"color": f"@{curve.role}/{look[0]}"}}
        trace["marker"]["size"] = look[1]
    if curve.style == "steps":
        trace["line"]["shape"] = "hv"
    if curve.style == "ghost":
        trace |= {"visible": False}
    if curve.shade is not None:
        trace |= {"mode": "lines+markers", "text": curve.shade[index]}
        trace["marker"] = _shaded(curve.shade[index], curve.shade_name)
        trace["hovertemplate"] += "<br>" + curve.shade_name + " %{text:.3g}"
    return trace


def _shaded(values: Array, name: str) -> dict[str, Any]:
    bar = {"title": {"text": name, "side": "right"}, "thickness": 12, "outlinewidth": 0}
    return {"color": values, "size": 7, "colorscale": SHADES, "showscale": True, "colorbar": bar}


def _dots(panel: Panel, dots: Sequence[Dot]) -> dict[str, Any]:
    """Return the trace of marks of one style; those without a finite y are on the lower edge."""
    heights = np.array([float(panel.height(d.y)) for d in dots])
    low, high = panel.ranges()[1]
    y = np.where(np.isfinite(heights), heights, low + 0.04 * (high - low))
    one = dots[0]
    size, width = (9, 1.5) if one.shape in ("disc", "ring") else (11, 2.5)
    colour = f"@{one.role}"
    line = {"color": colour, "width": width}
    trace = {
        "type": "scatter", "mode": "markers", "x": np.array([d.x for d in dots]), "y": y,
        "text": [d.note.replace("\n", "<br>") for d in dots], "hovertemplate": "%{text}",
        "name": "", "meta": {"role": one.role, "trial": one.trial, "style": one.shape},
        "marker": {"symbol": SYMBOLS[one.shape], "color": colour, "size": size, "line": line},
        "cliponaxis": False,
    }  # fmt: skip
    if one.error > 0:
        ends = [(panel.height(d.y + d.error), panel.height(d.y - d.error)) for d in dots]
        up, down = np.array(ends, float).T
        trace["error_y"] = {
            "type": "data", "symmetric": False, "array": np.abs(up - y),
            "arrayminus": np.abs(y - down), "color": colour, "thickness": 1.2, "width": 0,
        }  # fmt: skip
    return trace


def key_trace(key: Key) -> dict[str, Any]:
    """Return a trace without points that stands for an entry of a legend."""
    colour = f"@{key.role}"
    trace: dict[str, Any] = {"type": "scatter", "x": [None], "y": [None], "name": key.name}
    if key.shape in SYMBOLS:
        look = {"size": 9, "color": colour, "line": {"width": 2, "color": colour}}
        return trace | {"mode": "markers", "marker": look | {"symbol": SYMBOLS[key.shape]}}
    if key.shape == "band":
        return trace | {"mode": "lines", "line": {"color": f"{colour}/0.3", "width": 10}}
    return trace | {"mode": "lines", "line": {"color": colour, "width": 2} | _dash(key.role)}


def _dash(role: str) -> dict[str, str]:
    dash = ",".join(f"{v:g}px" for v in DASHES.get(role, ()))
    return {"dash": dash} if dash else {}


def _flat(panel: Panel, low: float, high: float, axis: str) -> dict[str, Any]:
    bottom, top = (float(panel.height(v)) for v in (low, high))
    return {
        "type": "rect", "xref": f"x{axis} domain", "yref": f"y{axis}", "x0": 0, "x1": 1,
        "y0": bottom, "y1": top, "line": {"width": 0}, "layer": "below",
    }  # fmt: skip


def _line(panel: Panel, y: float, role: str, axis: str) -> dict[str, Any]:
    look = {"color": f"@{role}", "width": 1.2} | _dash(role)
    return _flat(panel, y, y, axis) | {
        "type": "line", "line": look, "layer": "above",
    }  # fmt: skip


def _bars(panel: Bars, axis: str) -> dict[str, Any]:
    bars = panel.bars[::-1]  # Plotly's first is the lowest
    trace = {
        "type": "bar", "orientation": "h", "x": panel.values[::-1], "y": list(range(len(bars))),
        "text": [bar.text for bar in bars], "textposition": "outside", "cliponaxis": False,
        "marker": {"color": [f"@{bar.role}" for bar in bars]}, "hoverinfo": "skip",
        "textfont": {"color": "@text"}, "xaxis": f"x{axis}", "yaxis": f"y{axis}",
        "meta": {"role": "", "trial": "", "style": "bar"},
    }  # fmt: skip
    across = {"range": [*panel.ends], "visible": False, "fixedrange": True}
    up = {
        "tickvals": list(range(len(bars))), "ticktext": [in_lines(bar.label) for bar in bars],
        "automargin": True, "fixedrange": True, "showgrid": False, "zeroline": False,
    }  # fmt: skip
    return {"data": [trace], "layout": {f"xaxis{axis}": across, f"yaxis{axis}": up}}


def in_lines(label: str) -> str:
    """Break a label that is too long for a small panel, after a blank, a colon or a plus."""
    if len(label) <= LABEL_LETTERS:
        return label
    lines = [""]
    for part in re.findall(r"[^ :+]+[ :+]?", label):
        if lines[-1] and len(lines[-1] + part.rstrip()) > LABEL_LETTERS:
            lines.append("")
        lines[-1] += part
    return "<br>".join(line.rstrip() for line in lines)


def label_lines(panel: Bars) -> int:
    """Return in how many lines the longest label of bars is broken."""
    return max((in_lines(bar.label).count("<br>") + 1 for bar in panel.bars), default=1)


def coloured(value: Any, dark: bool = False) -> Any:
    """Replace the roles in a plotted value by colours."""
    if isinstance(value, dict):
        return {key: coloured(item, dark) for key, item in value.items()}
    if isinstance(value, list):
        return [coloured(item, dark) for item in value]
    if not (isinstance(value, str) and value.startswith("@")):
        return value
    role, _, opacity = value[1:].partition("/")
    colour = (COLOURS | PAPER)[role][dark]
    return f"rgba({','.join(map(str, rgb(colour)))},{opacity})" if opacity else colour


def palette() -> dict[str, tuple[str, str]]:
    """Return every role's colour on white and on black."""
    return COLOURS | PAPER


def packed(array: Array) -> dict[str, Any]:
    """Encode an array as text, with two bytes a number: 65,535 steps of its range, the last is NaN.

    Four or eight bytes are used if those steps are too coarse because of a few outliers.
    """
    values = np.where(np.isfinite(array), array, np.nan)
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
    inner = np.ptp(np.quantile(known, [0.02, 0.98])) if len(known) else 0.0
    if high - low <= COARSE * inner or high == low:
        step = (high - low) / (STEPS - 1)
        counts = np.rint((values - low) / (step or 1.0))
        raw = np.where(np.isfinite(counts), counts, STEPS).astype("<u2").tobytes()
        found: dict[str, Any] = {"dtype": "u2", "from": low, "step": step}
    else:
        kind = "f4" if max(abs(low), abs(high)) < min(1e30, 1e4 * float(inner)) else "f8"
        raw, found = values.astype(f"<{kind}").tobytes(), {"dtype": kind}
    return found | {"bdata": base64.b64encode(raw).decode()}


def notebook_figure(figures: Sequence[Figure], height: int = 300) -> Any:
    """Return all panels of some figures as one Plotly figure, two side by side.

    Args:
        figures: the figures.
        height: height of a row of panels [px].

    Raises:
        GroundedError: if Plotly is not installed.
    """
    needs("plotly", "notebook")
    from plotly.graph_objects import Figure as Drawn
    from plotly.subplots import make_subplots

    panels = [panel for figure in figures for panel in figure.panels]
    columns = min(2, len(panels))
    rows = -(-len(panels) // 2)
    if not panels:
        return Drawn()
    titles = [_titled(panel) for panel in panels]
    left, right = (max((_letters(panel) for panel in panels[k::2]), default=0) for k in (0, 1))
    heights = [max(map(partial(_tall, height), panels[2 * k : 2 * k + 2])) for k in range(rows)]
    made = make_subplots(
        rows=rows, cols=columns, subplot_titles=titles, row_heights=heights,
        horizontal_spacing=min(max(0.12, LETTER * right), 0.4),
        vertical_spacing=SPACE / (sum(heights) + SPACE * rows),
    )  # fmt: skip
    named: set[tuple[str, str]] = set()
    for k, panel in enumerate(panels):
        found = coloured(plotted(panel, str(k + 1) if k else ""))
        for trace in found["data"]:
            known = (str(trace.get("line")), trace.get("name", ""))
            context = trace["meta"]["role"] == "other" and trace["meta"]["trial"]
            trace["showlegend"] = bool(trace.get("name")) and known not in named and not context
            trace["meta"] = None
            if "colorbar" in trace.get("marker", {}):
                trace["marker"]["showscale"] = False  # it would be as high as all rows together
            trace["legendgroup"] = trace.get("name", "")
            named.add(known)
            made.add_trace(trace)
        shapes = found["layout"].pop("shapes", [])
        made.update_layout(found["layout"])
        for shape in shapes:
            made.add_shape(shape)
    keys = {(k.role, k.name): k for figure in figures for k in figure.key if not k.trial}
    for key in keys.values():
        if all(key.name != name for _, name in named):  # marks have no names of their own
            made.add_trace(coloured(key_trace(key)))
    total = sum(heights) + SPACE * rows + 80
    made.update_layout(
        height=total, template="plotly_white", title=_title(figures),
        margin={"t": 90, "b": 40, "l": max(80, WIDE * left)},
        legend={"orientation": "h", "yanchor": "top", "y": -70 / total}, showlegend=True,
    )  # fmt: skip
    return made


def _tall(height: int, panel: Panel | Bars) -> int:
    """Return the height of a panel's plot [px]."""
    if not isinstance(panel, Bars):
        return height - SPACE
    return max((4 + 15 * label_lines(panel)) * len(panel.bars), 60)


def _letters(panel: Panel | Bars) -> int:
    """Return the length of the longest line of a label of bars."""
    bars = panel.bars if isinstance(panel, Bars) else ()
    return max((len(part) for bar in bars for part in in_lines(bar.label).split("<br>")), default=0)


def _titled(panel: Panel | Bars) -> str:
    note = "" if isinstance(panel, Bars) else panel.note
    return f"{panel.title}<br><sub>{note}</sub>" if note else panel.title


def _title(figures: Sequence[Figure]) -> Mapping[str, str] | None:
    return {"text": figures[0].title} if len(figures) == 1 else None
