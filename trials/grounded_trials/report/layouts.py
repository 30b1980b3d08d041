"""Writes layouts that show a trial in Foxglove (or Lichtblick) and in PlotJuggler.

Both plot each state and input with the prediction of the candidate that was run. Foxglove also
shows the robot in space if a bag of standard messages is opened (`export t0007 --format bag`). Open
the layout, then a trial from trials/ and its candidate from candidates/.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from grounded.model import Model
from grounded_trials.report.scene import scene_of
from grounded_trials.store.store import write_atomically

FOXGLOVE, PLOTJUGGLER = "foxglove-layout.json", "plotjuggler-layout.xml"
REAL, PREDICTED = "#d55e00", "#0072b2"  # distinguishable for colour-blind readers


def write_layouts(folder: Path, model: Model) -> tuple[Path, Path]:
    """Write both layouts into an existing folder; return their paths."""
    foxglove, plotjuggler = folder / FOXGLOVE, folder / PLOTJUGGLER
    write_atomically(foxglove, (json.dumps(foxglove_layout(model), indent=1) + "\n").encode())
    write_atomically(plotjuggler, plotjuggler_layout(model))
    return foxglove, plotjuggler


def _curves(model: Model) -> list[tuple[str, str, list[tuple[str, str]]]]:
    """Return for each plot its name, its unit, and (topic and field, colour) of its curves."""
    plots = [
        (name, unit, [(f"state.{name}", REAL), (f"predicted_state.{name}", PREDICTED)])
        for name, unit in model.states.items()
    ]
    return plots + [
        (name, unit, [(f"input.{name}", REAL), (f"predicted_input.{name}", PREDICTED)])
        for name, unit in model.inputs.items()
    ]


def foxglove_layout(model: Model) -> dict[str, Any]:
    """Return the layout in Foxglove's format."""
    panels: dict[str, Any] = {}
    for i, (name, unit, curves) in enumerate(_curves(model)):
        panels[f"Plot!grounded{i}"] = {
            "title": f"{name} [{unit}]",
            "paths": [
                {
                    "value": f"/{path}",
                    "enabled": True,
                    "timestampMethod": "publishTime",
                    "color": color,
                    "label": path.partition(".")[0].replace("_", " "),
                }
                for path, color in curves
            ],
            "showXAxisLabels": True,
            "showYAxisLabels": True,
            "showLegend": True,
            "legendDisplay": "floating",
            "isSynced": True,
            "xAxisVal": "timestamp",
        }
    names = list(panels)
    half = (len(names) + 1) // 2
    layout: Any = {
        "first": _stacked(names[:half]),
        "second": _stacked(names[half:]),
        "direction": "row",
    }
    if scene_of(model).spatial:
        topics = {topic: {"visible": True} for topic in ("/pose", "/target", "/tf")}
        panels["3D!grounded"] = {"followMode": "follow-none", "topics": topics}
        layout = {"first": "3D!grounded", "second": layout, "direction": "row"}
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": layout if len(names) > 1 else names[0],
    }


def _stacked(names: list[str]) -> Any:
    """Stack panels of equal height."""
    if len(names) == 1:
        return names[0]
    share = 100 / len(names)
    rest = _stacked(names[1:])
    return {"first": names[0], "second": rest, "direction": "column", "splitPercentage": share}


def plotjuggler_layout(model: Model) -> bytes:
    """Return the layout in PlotJuggler's format: a tab of the states, one of the inputs."""
    root = ElementTree.Element("root")
    window = {"parent": "main_window", "name": "Main Window"}
    tabs = ElementTree.SubElement(root, "tabbed_widget", window)
    plots = _curves(model)
    for title, some in (("states", plots[: model.n]), ("inputs", plots[model.n :])):
        tab = ElementTree.SubElement(tabs, "Tab", {"containers": "1", "tab_name": title})
        sizes = ";".join([f"{1 / len(some):.6f}"] * len(some))
        splitter = ElementTree.SubElement(
            ElementTree.SubElement(tab, "Container"),
            "DockSplitter",
            {"count": str(len(some)), "orientation": "-", "sizes": sizes},
        )
        for name, unit, curves in some:
            area = ElementTree.SubElement(splitter, "DockArea", {"name": f"{name} [{unit}]"})
            plot = ElementTree.SubElement(area, "plot", {"mode": "TimeSeries", "style": "Lines"})
            ElementTree.SubElement(plot, "limitY")
            for path, color in curves:
                curve = {"name": "/" + path.replace(".", "/"), "color": color}
                ElementTree.SubElement(plot, "curve", curve)
    ElementTree.SubElement(tabs, "currentTabIndex", {"index": "0"})
    ElementTree.SubElement(root, "use_relative_time_offset", {"enabled": "1"})
    ElementTree.indent(root)
    return bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)) + b"\n"
