"""Figures as Plotly's own data: a page, a notebook and a picture draw the same traces.

`curve` and `marks` make the contents of a `panel`: traces and a layout as Plotly's JSON has them,
with arrays in place of lists. Whatever has a name is in the
legend of its figure. Colours are roles ("@best", or "@best/0.15" with an opacity), so that a page
follows the reader's light or dark mode. No function here needs Plotly.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from grounded.errors import needs
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
PALETTE = COLOURS | {
    "text": ("#1a1a1a", "#e8e8e8"),
    "grid": ("#e3e3e3", "#31363b"),
    "paper": ("#ffffff", "#16181b"),
}
STEPS = ("step1", "step2", "step3")  # roles of iterations, in order
WIDTHS = {"best": 2.5, "desired": 1.0}  # line widths of paths; 1.5 for the other roles
DASHES = {
    "desired": (6.0, 3.0),
    "predicted": (2.0, 2.0),
    "limit": (8.0, 2.0, 2.0, 2.0),
    "step2": (5.0, 2.0),
}
SYMBOLS = {"disc": "circle", "ring": "circle-open", "cross": "x-thin", "dash": "line-ew"}
TYPESET = {"^2": "²", "^3": "³", "->": "→", "+-": "±"}
SMALLEST_RANGE = 1e-12  # range below which differences are rounding errors
MOST_POINTS = 1600  # most points of a curve
CONTEXT = 300  # most points of a curve that is only context
TICKS = 5  # most ticks of a logarithmic axis
HEIGHT, SPACE = 200, 100  # of a row of panels in a notebook, and between rows [px]
Trace = dict[str, Any]


class Key(NamedTuple):
    """An entry of a figure's legend; `trial` is set for the path of a trial of role "other"."""

    role: str
    name: str
    shape: str = "line"  # line, band, or one of SYMBOLS
    trial: str = ""


@dataclass(frozen=True, eq=False)
class Panel:
    """Axes with traces; `layout` has Plotly's xaxis, yaxis and shapes."""

    title: str
    data: Sequence[Trace]
    layout: Mapping[str, Any] = field(default_factory=dict)
    note: str = ""  # text behind the title
    kind: str = ""  # time or forecast: x is a time; path: positions of a run

    @property
    def curves(self) -> list[Trace]:
        """The traces that are no marks."""
        return [t for t in self.data if t["meta"]["style"] not in SYMBOLS]


@dataclass(frozen=True, eq=False)
class Figure:
    """Panels that belong together, with one legend; `name` is the name of its file."""

    name: str
    title: str
    caption: str
    panels: Sequence[Panel]

    @property
    def key(self) -> list[Key]:
        """The legend: every named trace, rule and band once, those for context last."""
        found = dict[tuple[str, str], Key]()
        for one in self.panels:
            for trace in one.data:
                (role, trial, style), name = trace["meta"].values(), trace["name"]
                if name and style != "ghost":
                    shape = {"points": "disc", "steps": "line"}.get(style, style)
                    key = Key(role, name, shape, trial if role == "other" else "")
                    found.setdefault((role, name), key)
            for shape in one.layout.get("shapes", ()):
                if name := shape.get("name"):
                    kind = "line" if shape["type"] == "line" else "band"
                    role = (shape.get("fillcolor") or shape["line"]["color"])[1:].partition("/")[0]
                    found.setdefault((role, name), Key(role, name, kind))
        return sorted(found.values(), key=lambda key: key.role == "other")


class Body(Protocol):
    """A moving robot as a stick figure in space, and the path of its end."""

    @property
    def unit(self) -> str:
        """Unit of positions; "" if its size is unknown."""

    def sticks(self, states: Array) -> Array:
        """Return the ends (T, S, 2, 3) of S lines for states (T, n)."""

    def path(self, states: Array) -> Array:
        """Return positions (T, 3) of the body, or its end; NaN where a state is unknown."""


def typeset(value: Any) -> Any:
    """Replace plain notation by typographic signs; values other than plain str are unchanged."""
    if type(value) is str:
        for plain, sign in TYPESET.items():
            value = value.replace(plain, sign)
    return value


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue of "#rrggbb"."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


# contents of a panel


def curve(
    x: Array,
    y: Array,
    role: str,
    name: str = "",
    width: float = 1.5,
    *,
    style: str = "line",
    trial: str = "",
    times: Array | None = None,
    note: str = "",
) -> Trace:
    """Return a line through points; NaN breaks it. Curves for context have no name.

    Args:
        x: (T,) positions.
        y: (T,) values.
        role: its colour.
        name: its name in the legend.
        width: of the line [px].
        style: line, steps (each y holds until the next x), points, or ghost: not drawn, only for
            the marks of the page's slider.
        trial: the trial whose path it is.
        times: (T,) time of each point of a path [s].
        note: text shown before y on hovering.
    """
    near = name and role != "other" and style != "ghost"
    index = thinned(x, y, MOST_POINTS if near else CONTEXT)
    hover = f"{note}: %{{y:.5g}}" if note else "%{y:.5g}"
    trace: Trace = {
        "type": "scatter", "mode": "lines", "x": x[index], "y": y[index], "name": name,
        "line": {"color": f"@{role}", "width": width} | _dash(role), "hovertemplate": hover,
        "meta": {"role": role, "trial": trial, "style": style},
    }  # fmt: skip
    if times is not None:
        trace["customdata"] = times[index]
        trace["hovertemplate"] = "%{customdata:.2f} s: (%{x:.4g}, %{y:.4g})"
    if not name:
        trace |= {"hoverinfo": "skip", "hovertemplate": ""}
    if style == "points":
        trace |= {"mode": "markers", "marker": {"color": f"@{role}/0.5", "size": 5}}
    elif style == "steps":
        trace["line"]["shape"] = "hv"
    elif style == "ghost":
        trace["visible"] = False
    return trace


def rule(y: float, role: str, name: str) -> Trace:
    """Return a horizontal line across the panel."""
    line = {"color": f"@{role}", "width": 1.2} | _dash(role)
    return _across(y, y) | {"type": "line", "line": line, "layer": "above", "name": name}


def band(low: float, high: float, role: str, name: str) -> Trace:
    """Return a faint horizontal band across the panel."""
    look = {"type": "rect", "fillcolor": f"@{role}/0.15", "line": {"width": 0}, "layer": "below"}
    return _across(low, high) | look | {"name": name}


def _across(low: float, high: float) -> Trace:
    return {"xref": "x domain", "yref": "y", "x0": 0, "x1": 1, "y0": low, "y1": high}


def _dash(role: str) -> dict[str, str]:
    dash = ",".join(f"{v:g}px" for v in DASHES.get(role, ()))
    return {"dash": dash} if dash else {}


def marks(
    x: Sequence[float],
    y: Sequence[float],
    role: str,
    notes: Sequence[str],
    *,
    shape: str = "disc",
    name: str = "",
    errors: Sequence[float] = (),
    trial: str = "",
) -> Trace:
    """Return marks with the texts `notes` on hovering, and error bars of half heights `errors`.

    A value that is not finite is drawn on the lower edge.
    """
    size, width = (9, 1.5) if shape in ("disc", "ring") else (11, 2.5)
    look = {"color": f"@{role}", "line": {"color": f"@{role}", "width": width}}
    trace: Trace = {
        "type": "scatter", "mode": "markers", "x": np.array(x, float), "y": np.array(y, float),
        "text": [note.replace("\n", "<br>") for note in notes], "name": name,
        "hovertemplate": "%{text}<extra></extra>", "cliponaxis": False,
        "meta": {"role": role, "trial": trial, "style": shape},
        "marker": look | {"symbol": SYMBOLS[shape], "size": size},
    }  # fmt: skip
    if any(errors):
        trace["error_y"] = {
            "type": "data", "array": np.array(errors), "color": f"@{role}", "thickness": 1.2,
            "width": 0,
        }  # fmt: skip
    return trace


def panel(
    title: str,
    x_name: str,
    y_name: str,
    traces: Sequence[Trace],
    shapes: Sequence[Trace] = (),
    *,
    equal: bool = False,
    loss: bool = False,
    log: bool = False,
    x_range: tuple[float, float] | None = None,
    x_ticks: Sequence[tuple[float, str]] = (),
    y_range: tuple[float, float] | None = None,
    note: str = "",
    kind: str = "",
) -> Panel:
    """Return axes that contain every named curve, every mark and every rule.

    Args:
        title: see `Panel`.
        x_name: title of the x axis.
        y_name: title of the y axis.
        traces: made by `curve` and `marks`.
        shapes: made by `rule` and `band`.
        equal: equal scales on both axes.
        loss: the y axis shows losses y < 0 by the logarithm of -y, the smallest at the top.
        log: both axes are logarithmic; what has no logarithm is left out.
        x_range: ends of the x axis, if not those of the contents.
        x_ticks: positions and labels of ticks; () for automatic.
        y_range: ends of the y axis.
        note: see `Panel`.
        kind: see `Panel`.
    """
    upright = log or loss
    if loss:
        traces, shapes = _costs(traces, shapes)

    # what must be seen: marks, and curves with a name, or all where none has one
    drawn = [one for one in traces if one["meta"]["style"] != "ghost"]
    dots = [one for one in drawn if one["meta"]["style"] in SYMBOLS]
    lines = [one for one in drawn if one["meta"]["style"] not in SYMBOLS]
    seen = [*([one for one in lines if one["name"]] or lines), *dots]
    xs = [one["x"] for one in seen]
    rules = [one["y0"] for one in shapes if one["type"] == "line"]
    ys = [*(one["y"] for one in seen), np.array(rules, float)]

    if log:
        traces = [_positive(one) for one in traces]

    # the axes
    margin = 0.06 if equal else 0.03 if dots or kind != "time" else 0.0
    across = _axis(x_name, x_range or fitted(xs, margin, log=log), log=log)
    up = _axis(y_name, y_range or fitted(ys, log=upright), log=upright)
    if loss:
        ticks = [f"−{text}" for text in up["ticktext"]]
        up |= {"range": up["range"][::-1], "ticktext": ticks}
    if x_ticks:
        at, labels = zip(*x_ticks, strict=True)
        labels = tuple(label.replace("\n", "<br>") for label in labels)
        across |= {"tickvals": list(at), "ticktext": [*labels], "ticklabeloverflow": "allow"}
    if equal:
        up["scaleanchor"] = "x"

    # marks without a value are on the lower edge
    edge = 10.0 ** up["range"][0] if upright else up["range"][0]
    for one in dots:
        one["y"][~np.isfinite(one["y"])] = edge
    return Panel(title, traces, {"xaxis": across, "yaxis": up, "shapes": [*shapes]}, note, kind)


def _costs(
    traces: Sequence[Trace], shapes: Sequence[Trace]
) -> tuple[Sequence[Trace], Sequence[Trace]]:
    """Return losses as the costs -y; what is no loss is drawn as the smallest."""
    values = [one["y"] for one in traces]
    values += [np.array([one["y0"]]) for one in shapes if one["type"] == "line"]
    least = min((-float(y[y < 0].max()) for y in values if (y < 0).any()), default=1.0)
    ends = ({end: max(-one[end], least) for end in ("y0", "y1")} for one in shapes)
    costs = [one | {"y": np.maximum(-one["y"], least)} for one in traces]
    return costs, [one | changed for one, changed in zip(shapes, ends, strict=True)]


def _positive(trace: Trace) -> Trace:
    """Return the points of a line that have a logarithm, with a mark at each."""
    known, mode = trace["y"] > 0, trace["mode"].replace("lines", "lines+markers")
    return trace | {"x": trace["x"][known], "y": trace["y"][known], "mode": mode}


def _axis(name: str, ends: tuple[float, float], *, log: bool) -> dict[str, Any]:
    axis: dict[str, Any] = {
        "title": {"text": name, "standoff": 6}, "range": [*ends], "gridcolor": "@grid",
        "zeroline": False, "linecolor": "@grid", "automargin": True,
    }  # fmt: skip
    if log:
        ticks = log_ticks(*ends)
        axis |= {"type": "log", "tickvals": ticks, "ticktext": [f"{v:g}" for v in ticks]}
    return axis


def key_trace(key: Key) -> Trace:
    """Return a trace without points that stands for an entry of a legend."""
    colour = f"@{key.role}"
    trace: Trace = {"type": "scatter", "x": [None], "y": [None], "name": key.name, "mode": "lines"}
    if key.shape in SYMBOLS:
        look = {"size": 9, "color": colour, "line": {"width": 2, "color": colour}}
        return trace | {"mode": "markers", "marker": look | {"symbol": SYMBOLS[key.shape]}}
    if key.shape == "band":
        return trace | {"line": {"color": f"{colour}/0.3", "width": 10}}
    return trace | {"line": {"color": colour, "width": 2} | _dash(key.role)}


# ranges, ticks, points


def fitted(
    values: Iterable[Array], margin: float = 0.06, *, log: bool = False
) -> tuple[float, float]:
    """Return a range around the finite values, or around their logarithms, with a margin."""
    if log:
        values = (np.log10(v[v > 0]) for v in values)
    kept = [v[np.isfinite(v)] for v in values]
    kept = [v for v in kept if len(v)]
    if not kept:
        return 0.0, 1.0
    low, high = min(float(v.min()) for v in kept), max(float(v.max()) for v in kept)
    size = max(abs(low), abs(high))
    span = high - low if high - low > 1e-9 * size else 0.0
    room = margin * span if span > SMALLEST_RANGE else max(0.05 * size, SMALLEST_RANGE)
    return low - room, high + room


def calm_range(
    calm: Sequence[Array], wild: Sequence[Array], most: float = 5.0
) -> tuple[float, float]:
    """Return a range around all values, or of the calm ones if all span `most` times as much.

    So a run that diverges does not flatten the picture of the others.
    """
    (low, high), (left, right) = fitted(calm), fitted([*calm, *wild])
    moves = any(np.ptp(v[np.isfinite(v)]) > 0 for v in calm if np.isfinite(v).any())
    return (low, high) if moves and right - left > most * (high - low) else (left, right)


def log_ticks(low: float, high: float) -> list[float]:
    """Return ticks for an axis of values from 10^low to 10^high: 1, 2, 5, 10 ..."""
    powers = np.arange(np.floor(low) - 1, np.ceil(high) + 2)
    values: list[float] = []
    for factors in ((1, 1.5, 2, 3, 5, 7), (1, 2, 5), (1, 3), (1,)):
        every = [f * 10.0**k for k in powers.tolist() for f in factors]
        values = [v for v in every if low <= np.log10(v) <= high]
        if len(values) <= TICKS:
            break
    if len(values) < 2:
        return sorted(float(f"{10.0**v:.2g}") for v in np.linspace(low, high, 4))
    return values[:: -(-len(values) // (TICKS + 2))]  # of many powers of ten every second, third


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


# in a notebook


def _coloured(value: Any) -> Any:
    """Replace the roles in a trace or layout by colours on white."""
    if isinstance(value, dict):
        return {key: _coloured(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_coloured(item) for item in value]
    if not (isinstance(value, str) and value.startswith("@")):
        return value
    role, _, opacity = value[1:].partition("/")
    colour = PALETTE[role][0]
    return f"rgba({','.join(map(str, rgb(colour)))},{opacity})" if opacity else colour


def notebook_figure(figures: Sequence[Figure]) -> Any:
    """Return all panels of some figures as one Plotly figure, two side by side.

    Raises:
        GroundedError: if Plotly is not installed.
    """
    needs("plotly", "notebook")
    from plotly.graph_objects import Figure as Drawn
    from plotly.subplots import make_subplots

    panels = [panel for figure in figures for panel in figure.panels]
    columns, rows = min(2, len(panels)), -(-len(panels) // 2)
    if not panels:
        return Drawn()
    total = (HEIGHT + SPACE) * rows
    titles = [f"{p.title}<br><sub>{p.note}</sub>" if p.note else p.title for p in panels]
    made = make_subplots(
        rows=rows, cols=columns, subplot_titles=titles, horizontal_spacing=0.12,
        vertical_spacing=SPACE / total,
    )  # fmt: skip

    # the traces, each name once in the legend
    named = set[tuple[str, str]]()
    for k, panel in enumerate(panels):
        at = {"row": k // 2 + 1, "col": k % 2 + 1}
        for trace in _coloured([*panel.data]):
            known, meta = (str(trace.get("line")), trace["name"]), trace.pop("meta")
            context = meta["role"] == "other" and meta["trial"]
            shows = bool(trace["name"]) and known not in named and not context
            made.add_trace(trace | {"showlegend": shows, "legendgroup": trace["name"]}, **at)
            named.add(known)
        layout = _coloured(dict(panel.layout))
        if "scaleanchor" in layout["yaxis"]:
            layout["yaxis"]["scaleanchor"] = f"x{k + 1 if k else ''}"
        made.update_xaxes(layout["xaxis"], **at)
        made.update_yaxes(layout["yaxis"], **at)
        for shape in layout.get("shapes", ()):
            made.add_shape(shape, **at)
    keys = {(k.role, k.name): k for figure in figures for k in figure.key if not k.trial}
    for key in keys.values():
        if all(key.name != name for _, name in named):  # rules and bands are no traces
            made.add_trace(_coloured(key_trace(key)))

    made.update_layout(
        height=total + 80, template="plotly_white", margin={"t": 90, "b": 40, "l": 80},
        title={"text": figures[0].title} if len(figures) == 1 else None,
        legend={"orientation": "h", "yanchor": "top", "y": -70 / (total + 80)}, showlegend=True,
    )  # fmt: skip
    return made
