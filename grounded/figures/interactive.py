"""Figures in colours, and `notebook_figure`: what `.plot()` returns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from grounded.errors import needs
from grounded.figures.figure import COLOURS, Figure, key_trace, rgb

PALETTE = COLOURS | {  # every role's colour on white and on black
    "text": ("#1a1a1a", "#e8e8e8"),
    "grid": ("#e3e3e3", "#31363b"),
    "paper": ("#ffffff", "#16181b"),
}
HEIGHT, SPACE = 200, 100  # of a row, and between rows [px]


def coloured(value: Any, dark: bool = False) -> Any:
    """Replace the roles in a trace or layout by colours."""
    if isinstance(value, dict):
        return {key: coloured(item, dark) for key, item in value.items()}
    if isinstance(value, list):
        return [coloured(item, dark) for item in value]
    if not (isinstance(value, str) and value.startswith("@")):
        return value
    role, _, opacity = value[1:].partition("/")
    colour = PALETTE[role][dark]
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
        for trace in coloured([*panel.data]):
            known, meta = (str(trace.get("line")), trace["name"]), trace.pop("meta")
            context = meta["role"] == "other" and meta["trial"]
            shows = bool(trace["name"]) and known not in named and not context
            made.add_trace(trace | {"showlegend": shows, "legendgroup": trace["name"]}, **at)
            named.add(known)
        layout = coloured(dict(panel.layout))
        if "scaleanchor" in layout["yaxis"]:
            layout["yaxis"]["scaleanchor"] = f"x{k + 1 if k else ''}"
        made.update_xaxes(layout["xaxis"], **at)
        made.update_yaxes(layout["yaxis"], **at)
        for shape in layout.get("shapes", ()):
            made.add_shape(shape, **at)
    keys = {(k.role, k.name): k for figure in figures for k in figure.key if not k.trial}
    for key in keys.values():
        if all(key.name != name for _, name in named):  # rules and bands are no traces
            made.add_trace(coloured(key_trace(key)))

    made.update_layout(
        height=total + 80, template="plotly_white", margin={"t": 90, "b": 40, "l": 80},
        title={"text": figures[0].title} if len(figures) == 1 else None,
        legend={"orientation": "h", "yanchor": "top", "y": -70 / (total + 80)}, showlegend=True,
    )  # fmt: skip
    return made
