"""The recording's blueprint: which views the viewer opens with, and where it looks from."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from grounded.frozen import Array
from grounded_trials.report.findings import Findings
from grounded_trials.report.scene import Scene
from grounded_trials.wording import labelled, per_second

TRIALS = 60  # that get a tab of their own
NAMES = {"state": "states", "input": "inputs", "bias": "bias"}
FIRST = 4  # states in the overview; all of them have a tab


def blueprint(findings: Findings, scene: Scene) -> Any:
    """Overview, states, inputs, bias, and a tab for each trial."""
    import rerun.blueprint as rrb

    model = findings.task.model
    states = [_plot(f"/state/{n}", labelled(n, u)) for n, u in model.states.items()]
    inputs = [_plot(f"/input/{n}", labelled(n, u)) for n, u in model.inputs.items()]
    biases = [_plot(f"/bias/{n}", labelled(n, per_second(u))) for n, u in model.states.items()]
    tabs = [
        _overview(findings, scene),
        rrb.Grid(*states, name="States"),
        rrb.Grid(*inputs, name="Inputs"),
        rrb.Grid(*biases, name="Bias"),
        rrb.Tabs(*_trials(findings, scene), name="By trial"),
    ]
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=4 if findings.logs and not findings.runs else 0),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time"),
        auto_views=False,
        auto_layout=False,
    )


def _overview(findings: Findings, scene: Scene) -> Any:
    import rerun.blueprint as rrb

    model, reward = findings.task.model, findings.task.reward
    weighed = reward.state + reward.terminal != 0
    chosen = sorted(model.states, key=lambda n: not weighed[model.state_names.index(n)])[:FIRST]
    axes = [labelled(name, unit) for name, unit in zip(scene.names, scene.units, strict=True)]
    title = "Paths: " + " over ".join(reversed(axes)) if len(axes) == 2 else "Paths"
    named = [(f"/state/{n}", f"{n} [{model.states[n]}]") for n in chosen]
    named += [(f"/input/{n}", labelled(n, u)) for n, u in list(model.inputs.items())[:2]]
    named += [
        (f"/bias/{n}", labelled(f"bias of {n}", per_second(model.states[n]))) for n in chosen[:2]
    ]
    plots = [_plot(origin, name, legend=False) for origin, name in named]
    charts = [("/utilities", "Utility by iteration")]
    if findings.diagnosis is not None and findings.diagnosis.credit:
        charts.append(("/credit", "Credit: share of what predictions gain [%]"))
    hidden = rrb.PlotLegend(visible=False)
    bars = [rrb.BarChartView(origin=at, name=name, plot_legend=hidden) for at, name in charts]
    left = rrb.Vertical(
        rrb.TextDocumentView(origin="/verdict", name="Why the model was wrong, what to run next"),
        _space(findings, scene, ["/paths/**"], title),
        rrb.Horizontal(*bars, rrb.TextDocumentView(origin="/summary", name="Summary")),
        row_shares=[2, 4, 2],
    )
    right = rrb.Grid(*plots, grid_columns=2)
    return rrb.Horizontal(left, right, name="Overview", column_shares=[1, 1])


def _trials(findings: Findings, scene: Scene) -> list[Any]:
    import rerun.blueprint as rrb

    shown = []
    for run in findings.runs[-TRIALS:]:
        names = dict(NAMES)
        if run.explained is not None:
            names["explained"] = "bias that is left after the diagnosis"
        about = f"{run.label}, utility {run.utility:.4g}"
        shown.append((f"/trials/{run.trial.id}", about, names, ["path", "predicted/**", "body"]))
    for log in findings.logs[-TRIALS:]:
        shown.append((f"/data/{log.trial.id}", f"{log.trial.id}, data", NAMES, ["path", "body"]))
    tabs = []
    for at, about, names, drawn in shown:
        contents = ["/paths/desired", *(f"{at}/{part}" for part in drawn)]
        plots = [_plot(f"{at}/{key}", name) for key, name in names.items()]
        space = _space(findings, scene, contents, about)
        tabs.append(rrb.Horizontal(space, rrb.Vertical(*plots), name=at.split("/")[-1]))
    return tabs


def _plot(origin: str, name: str, legend: bool = True) -> Any:
    import rerun.blueprint as rrb

    key = rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend)
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=key)


def _space(findings: Findings, scene: Scene, contents: list[str], name: str) -> Any:
    """A view of space: from above for a plane (so that y points up), from the side for a volume."""
    import rerun.blueprint as rrb

    centre, extent = _bounds(findings, scene)
    direction = np.array([0.0, -1.0, 0.7]) if scene.volume else np.array([0.0, 0.0, 1.0])
    distance = max(extent, 1e-3) * 1.1
    eye = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=centre + distance * direction / np.linalg.norm(direction),
        look_target=centre,
        eye_up=(0, 0, 1) if scene.volume else (0, 1, 0),
    )
    spacing = 10.0 ** math.floor(math.log10(max(extent, 1e-3) / 2))
    grid = rrb.LineGrid3D(visible=True, spacing=spacing, color=(90, 90, 90, 60))
    return rrb.Spatial3DView(
        origin="/", contents=contents, name=name, eye_controls=eye, line_grid=grid
    )


def _bounds(findings: Findings, scene: Scene) -> tuple[Array, float]:
    """The middle and the size of all that is drawn, without runs that went astray."""
    shown = [findings.task.target]
    shown += [run.trial.states for run in (findings.best, findings.first) if run is not None]
    shown += [log.trial.states for log in findings.logs] if not findings.runs else []
    points = np.vstack([scene.finite(s) for s in shown])
    if not len(points):
        return np.zeros(3), 1.0
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2, float((high - low).max() or 1.0)
