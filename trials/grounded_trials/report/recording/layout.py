"""The recording's blueprint: the views that the viewer opens, and their camera positions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from grounded.figures.body import Body
from grounded.figures.figure import Bars, Figure, Panel, typeset
from grounded.frozen import Array
from grounded_trials.report.bodies import is_mechanism, reach
from grounded_trials.report.figures.gap import forecast_figures
from grounded_trials.report.figures.runs import bias_figure, input_figure, state_figure
from grounded_trials.report.findings import Findings
from grounded_trials.report.scene import Scene
from grounded_trials.wording import figure, labelled

CAMERA_DISTANCE = 1.1  # distance of the camera, times the size of the contents
TALL = 1.35  # the distance in a view that is higher than wide, times that
ASIDE = 1.5  # the same for a mechanism, whose parts have a width


@dataclass(frozen=True, eq=False)
class Space:
    """Views of the space that a body moves in: paths from above, mechanisms from the side."""

    findings: Findings
    scene: Scene
    body: Body

    @property
    def title(self) -> str:
        """The title of the first view."""
        if is_mechanism(self.body):
            return "From the side"
        axes = [labelled(*one) for one in zip(self.scene.names, self.scene.units, strict=True)]
        return "Paths: " + " over ".join(reversed(axes)) if len(axes) == 2 else "Paths"

    def view(self, contents: Sequence[str], name: str, tall: bool = False) -> Any:
        """Return a view of some entities; y points up from above, z from the side.

        A `tall` view is higher than wide: the camera is farther away, since it sees less aside.
        """
        (centre, extent), up = self._bounds, (0, 0, 1)
        distance = max(extent, 1e-3) * CAMERA_DISTANCE
        if is_mechanism(self.body):
            direction, distance = np.array([0.0, -1.0, 0.1]), max(extent, 1e-3) * ASIDE
        elif self.scene.volume:
            direction = np.array([0.0, -1.0, 0.7])
        else:
            direction, up = np.array([0.0, 0.0, 1.0]), (0, 1, 0)
        distance *= TALL if tall else 1.0
        eye = rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=centre + distance * direction / np.linalg.norm(direction),
            look_target=centre,
            eye_up=up,
        )
        spacing = 10.0 ** math.floor(math.log10(max(extent, 1e-3) / 2))
        grid = rrb.LineGrid3D(visible=True, spacing=spacing, color=(90, 90, 90, 60))
        return rrb.Spatial3DView(
            origin="/", contents=list(contents), name=name, eye_controls=eye, line_grid=grid
        )

    @cached_property
    def _bounds(self) -> tuple[Array, float]:
        """Centre and size of target, best and first run; others may diverge and are left out."""
        findings = self.findings
        shown = [findings.task.target]
        shown += [run.trial.states for run in (findings.best, findings.first) if run is not None]
        shown += [log.trial.states for log in findings.logs] if not findings.runs else []
        points = np.vstack([reach(self.body, states) for states in shown])
        if not len(points):
            return np.zeros(3), 1.0
        low, high = points.min(axis=0), points.max(axis=0)
        return (low + high) / 2, float((high - low).max() or 1.0)


TRIALS = 60  # largest number of trials with a tab of their own
NAMES = {"state": "states", "input": "inputs", "bias": "bias"}
FIRST = 4  # states in the overview; all of them have a tab


def over_time(findings: Findings) -> list[Figure]:
    """Return the page's figures over time: states, inputs, bias, forecasts."""
    made = (state_figure(findings), input_figure(findings), bias_figure(findings))
    return [figure for figure in (*made, *forecast_figures(findings)[:1]) if figure is not None]


def escaped(name: str) -> str:
    """Return a name as a part of an entity's path."""
    return rr.new_entity_path([name]).removeprefix("/")


def entity_of(figure: Figure, panel: Panel | Bars) -> str:
    """Return the path of a panel's entities."""
    return f"/{figure.name}/{escaped(panel.title)}"


def blueprint(findings: Findings, space: Space) -> Any:
    """Return the views: overview, effects on and off, states, inputs, bias, one tab per trial."""
    figures = over_time(findings)
    plots = {figure.name: _plots(figure) for figure in figures}
    tabs = [
        _overview(findings, space, plots),
        *_effects(findings, space, plots.pop("forecast", [])),
        *(rrb.Grid(*plots[one.name], name=one.title) for one in figures if one.name in plots),
        rrb.Tabs(*_trials(findings, space), name="By trial"),
    ]
    only_logs = bool(findings.logs) and not findings.runs
    shown: Any = rrb.Tabs(*tabs, active_tab=len(tabs) - 1 if only_logs else 0)
    if only_logs:  # opens at the logs, with the answer above them
        shown = rrb.Vertical(_answer(findings), shown, row_shares=_rows(findings))
    return rrb.Blueprint(
        shown,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time"),
        auto_views=False,
        auto_layout=False,
    )


def _overview(findings: Findings, space: Space, drawn: Mapping[str, Sequence[Any]]) -> Any:
    plots = [
        plot
        for name, most in (("states", FIRST), ("inputs", 2), ("bias", 2))
        for plot in drawn.get(name, ())[:most]
    ]
    hidden = rrb.PlotLegend(visible=False)
    bars = rrb.BarChartView(origin="/utilities", name="Utility by iteration", plot_legend=hidden)
    words = rrb.TextDocumentView(origin="/summary", name="Summary")
    left = rrb.Vertical(
        space.view(["/paths/**"], space.title),
        rrb.Horizontal(bars, words, column_shares=[1, 2]),
        row_shares=[3, 2],
    )
    right = rrb.Grid(*plots, grid_columns=2)
    below = rrb.Horizontal(left, right, column_shares=[1, 1])
    return rrb.Vertical(_answer(findings), below, name="Overview", row_shares=_rows(findings))


def _answer(findings: Findings) -> Any:
    """Return the views of the verdict and, beside it, of the credit: both seen at once."""
    told = rrb.TextDocumentView(origin="/verdict", name="Diagnosis")
    if findings.diagnosis is None or not findings.diagnosis.credit:
        return told
    worth = rrb.TextDocumentView(origin="/credit", name="Causes")
    return rrb.Horizontal(told, worth, column_shares=[3, 2])


def _rows(findings: Findings) -> list[float]:
    """Return the shares of the height of the answer and of what is below it."""
    return [1, 8] if findings.diagnosis is None else [2, 5]


def _effects(findings: Findings, space: Space, plots: Sequence[Any]) -> list[Any]:
    """Return views of a run and the model's forecasts, without effects and with them."""
    better = findings.better
    if better is None or not (findings.runs or findings.logs):
        return []
    views = [
        space.view(
            ["/ahead/real/**", f"/ahead/{key}/**"], f"{findings.ahead_s:.3g} s ahead: {words}"
        )
        for key, words in (("off", findings.plain), ("on", f"model {better.name}"))
    ]
    both = rrb.Horizontal(*views)
    return [rrb.Vertical(both, rrb.Grid(*plots, grid_columns=3), name="Effects off and on")]


def _trials(findings: Findings, space: Space) -> list[Any]:
    shown = []
    for run in findings.runs[-TRIALS:]:
        names = dict(NAMES)
        if run.explained is not None:
            names["explained"] = "bias as diagnosed"
        about = f"{run.label}, utility {figure(run.utility)}"
        shown.append(
            (f"/trials/{run.trial.id}", about, names, ["path", "predicted/**", "body/**", "crash"])
        )
    for log in findings.logs[-TRIALS:]:
        shown.append((f"/data/{log.trial.id}", f"{log.trial.id}, data", NAMES, ["path", "body/**"]))
    tabs = []
    for at, about, names, drawn in shown:
        contents = ["/paths/desired", *(f"{at}/{part}" for part in drawn)]
        plots = [_plot(f"{at}/{key}", name) for key, name in names.items()]
        view = space.view(contents, about, tall=True)
        tabs.append(rrb.Horizontal(view, rrb.Vertical(*plots), name=at.split("/")[-1]))
    return tabs


def _plots(figure: Figure) -> list[Any]:
    """Return a view of each panel of a figure."""
    return [_plot(entity_of(figure, panel), panel.title) for panel in figure.panels]


def _plot(origin: str, name: str) -> Any:
    key = rrb.PlotLegend(corner=rrb.Corner2D.LeftTop)
    return rrb.TimeSeriesView(origin=origin, name=typeset(name), plot_legend=key)
