"""Writes a workspace for the Rerun viewer, as one .rrd file. Only this module imports rerun.

    /paths/...                desired, the model's own policy, the best so far and its prediction
    /states, /inputs, /bias   the page's figures over time: a plot a panel, a curve an entity
    /forecast                 the same of a run and its predictions, restarted every second
    /trials/t0007/...         all of one trial: path, prediction, body, state, input, bias
    /data/t0003/...           the same for a log that ran no candidate
    /verdict                  what to run next, why the model was wrong, each cause
    /summary                  a summary in Markdown

There is one timeline, `time`, in seconds since the start of a trial. Numbers are logged as whole
columns, names and colours once. The file is derived from trials and may be deleted. All recordings
of one workspace have the same id, so that they can be merged (`rerun rrd merge`). `_Recorder`
writes the entities, `blueprint` places them in the viewer.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from grounded.figures import COLOURS as PAGE
from grounded.figures import Body, Figure, Panel, rgb, typeset
from grounded.frozen import Array
from grounded.trial import Trial
from grounded_trials.plain_file import unwritable
from grounded_trials.report.bodies import body_in, finite, is_mechanism, reach, scene_of
from grounded_trials.report.figures.paths import OTHERS
from grounded_trials.report.figures.runs import all_figures, averaged, window_of
from grounded_trials.report.findings import Findings, Run
from grounded_trials.report.tables import about, counted, improved
from grounded_trials.wording import figure, labelled, per_second

COLOURS = {role: rgb(dark) for role, (_, dark) in PAGE.items()}
COLOURS |= {"desired": (170, 170, 170), "other": (110, 110, 110)}
SERIES = [COLOURS[role] for role in ("best", "limit", "accepted", "step2", "predicted", "model")]
FRAMES = 600  # largest number of poses of a body in an animation
DISTANCE = 1.4  # of the camera, times the size of the contents
SIGNALS = {"state": "states", "input": "inputs", "bias": "bias"}  # of a trial
FIRST = {"states": 4, "inputs": 2, "bias": 2}  # plots in the overview; all have a tab


def write_recording(findings: Findings, path: Path) -> None:
    """Write the .rrd file of a workspace.

    Raises:
        GroundedError: if it can't be written.
    """
    rr.set_strict_mode(True)
    identity = hashlib.sha256(f"{findings.name} {findings.task.hash}".encode()).hexdigest()[:32]
    stream = rr.RecordingStream("grounded", recording_id=identity)
    body, temporary = body_in(findings), path.with_name(f".{path.name}.tmp")
    try:
        stream.save(temporary, default_blueprint=blueprint(findings, body))
        stream.send_recording_name(findings.name)
        _Recorder(stream, findings, body).everything()
        stream.flush()
        stream.disconnect()
        temporary.replace(path)
    except (OSError, RuntimeError) as error:
        raise unwritable(path, error) from None
    finally:
        temporary.unlink(missing_ok=True)


def over_time(findings: Findings) -> list[Figure]:
    """Return the page's figures over time: states, inputs, bias, the first forecast."""
    figures = {one.name: one for one in all_figures(findings)}
    ahead = [name for name in figures if name.startswith(("forecast", "data-"))][:1]
    return [figures[name] for name in (*FIRST, *ahead) if name in figures]


def escaped(name: str) -> str:
    """Return a name as a part of an entity's path."""
    return rr.new_entity_path([name]).removeprefix("/")


def entity_of(figure: Figure, panel: Panel) -> str:
    """Return the path of a panel's entities."""
    return f"/{figure.name}/{escaped(panel.title)}"


def texts(findings: Findings) -> dict[str, str]:
    """Return the texts of the recording by entity (Markdown)."""
    colours = "grey: desired; orange: model's policy; blue: best so far; pink: its prediction"
    if findings.better is not None and findings.best is not None:
        colours += f"; yellow: limits, and the bias that the model {findings.better.name} leaves"
    summary = [
        f"**{findings.name}**, {about(findings)}; {'; '.join(counted(findings))}",
        *(f"{value}: {what}" for value, what in improved(findings)),
        colours,
        f"**{findings.standing.outcome}**: {findings.standing.sentence}",
        *(f"**left out**: {one.file}: {one.reason}" for one in findings.lost),
    ]
    verdict, said = [f"next: `{findings.next_command}`", *findings.lines], findings.told
    if said is not None and said.rows:
        rows = (said.header, ("---",) * len(said.header), *said.rows)
        verdict.append("\n".join(f"| {' | '.join(row)} |" for row in rows))
    verdict += [] if findings.diagnosis else ["not diagnosed"]
    # names of tables are code: the viewer breaks lines after [
    return {
        name: typeset(re.sub(r"\[\w+\]", "`\\g<0>`", "\n\n".join(lines)))
        for name, lines in (("summary", summary), ("verdict", verdict))
    }


class _Recorder:
    """Records findings into a stream: methods for the contents first, then for single entities."""

    def __init__(self, stream: Any, findings: Findings, body: Body) -> None:
        self.stream, self.findings, self.body = stream, findings, body
        self.task, self.dt = findings.task, findings.task.dt

    def log(self, at: str, look: Any) -> None:
        """Record what holds at all times."""
        self.stream.log(at, look, static=True)

    def send(self, at: str, look: Any, times: Any, columns: Any) -> None:
        """Record columns of values at some times [s], and their look once."""
        self.log(at, look)
        self.stream.send_columns(at, [rr.TimeColumn("time", duration=times)], columns)

    def everything(self) -> None:
        findings = self.findings
        self.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        for name, text in texts(findings).items():
            self.log(name, rr.TextDocument(text, media_type="text/markdown"))
        self.paths()
        for drawn in over_time(findings):
            self.series(drawn)
        for run in findings.runs:
            at = f"trials/{run.trial.id}"
            self.trial(at, run.trial, run.residual, self.colour(run))
            self.moving(f"{at}/predicted", run.candidate.predicted_states, "predicted")
            if run.explained is not None:
                self.rates(f"{at}/explained", run.explained)
        for one in findings.logs:
            self.trial(f"data/{one.trial.id}", one.trial, one.residual, "best")

    def paths(self) -> None:
        """Record the paths of the overview, with a body on each path that was run."""
        first, best = self.findings.first, self.findings.best
        if np.isfinite(self.body.path(self.task.target)).all():
            self.path("paths/desired", self.task.target, "desired")
        waiting = self.findings.standing.outstanding
        if first is None and waiting is not None:
            self.path("paths/predicted", waiting.predicted_states, "predicted")
        if first is not None:
            self.moving("paths/model_policy", first.trial.states, "model")
        if best is not None and (first is None or best.candidate is not first.candidate):
            self.moving("paths/predicted", best.candidate.predicted_states, "predicted")
            self.moving("paths/best", best.trial.states, "best")

    def series(self, figure: Figure) -> None:
        """Record the curves, limits and marks of a figure over time."""
        for panel in figure.panels:
            at, end = entity_of(figure, panel), max(np.nanmax(one["x"]) for one in panel.curves)
            for trace in panel.data:
                role, name = trace["meta"]["role"], trace["name"]
                if trace["mode"] == "markers":
                    self.marks(f"{at}/{escaped(trace['text'][0])}", trace, role)
                else:
                    width = trace["line"]["width"]
                    self.line(f"{at}/{escaped(name)}", trace["x"], trace["y"], role, name, width)
            for shape in panel.layout["shapes"]:
                name, y = f"{shape['name']} {shape['y0']:g}", np.full(2, shape["y0"])
                self.line(f"{at}/{escaped(name)}", np.array([0.0, end]), y, "limit", shape["name"])

    def colour(self, run: Run) -> str:
        """Return the role of a run's colour in its own views."""
        compared = {"best": self.findings.best, "model": self.findings.first}
        for role, chosen in compared.items():
            if chosen is not None and run.candidate is chosen.candidate:
                return role
        crashed = self.task.utility(run.trial) == -np.inf
        return "limit" if crashed else "accepted" if run.accepted else "other"

    def trial(self, at: str, trial: Trial, residual: Array, colour: str) -> None:
        """Record a trial under its own name: path, body, states, inputs and bias."""
        model = self.task.model
        self.moving(at, trial.states, colour, "/path")
        self.columns(f"{at}/state", trial.states, self.dt, model.states)
        self.columns(f"{at}/input", trial.inputs, self.dt, model.inputs)
        self.rates(f"{at}/bias", residual)

    def rates(self, at: str, residual: Array) -> None:
        """Record a residual (T, n) as rates, averaged over some steps."""
        step = window_of(len(residual))
        units = {name: per_second(unit) for name, unit in self.task.model.states.items()}
        self.columns(at, averaged(residual, step) / self.dt, step * self.dt, units)

    def moving(self, at: str, states: Array, colour: str, path: str = "") -> None:
        """Record the path of states, and the body that moves and turns along it."""
        self.path(at + path, states, colour)
        rows = np.flatnonzero(np.isfinite(states).all(axis=1))
        rows = rows[:: max(1, len(rows) // FRAMES)]
        if not len(rows):
            return
        sticks, radius = self.body.sticks(states[rows]), rr.Radius.ui_points
        look: Any = None
        if sticks.size:
            look = rr.LineStrips3D.from_fields(colors=COLOURS[colour], radii=radius(2))
            columns = rr.LineStrips3D.columns(strips=[*sticks.reshape(-1, 2, 3)])
            columns = columns.partition([sticks.shape[1]] * len(rows))
        else:
            look = rr.Points3D.from_fields(colors=COLOURS[colour], radii=radius(6))
            columns = rr.Points3D.columns(positions=self.body.path(states[rows]))
        self.send(f"{at}/body", look, rows * self.dt, columns)

    def path(self, at: str, states: Array, colour: str) -> None:
        """Record a path in space as one static line."""
        points = finite(self.body.path(states))
        if len(points):
            look: Any = {"colors": COLOURS[colour], "radii": rr.Radius.ui_points(1.5)}
            self.log(at, rr.LineStrips3D([points], **look))

    def line(
        self, at: str, times: Array, values: Array, role: str, name: str, width: float = 1.0
    ) -> None:
        """Record the finite values of a curve over time."""
        look, keep = (
            rr.SeriesLines(colors=COLOURS[role], names=name, widths=width),
            np.isfinite(values),
        )
        self.send(at, look, times[keep], rr.Scalars.columns(scalars=values[keep]))

    def marks(self, at: str, trace: Mapping[str, Any], role: str) -> None:
        """Record the marks of a figure as crosses with a note."""
        look = rr.SeriesPoints(
            names=trace["text"][0], colors=COLOURS[role], markers="cross", marker_sizes=5.0
        )
        self.send(at, look, trace["x"], rr.Scalars.columns(scalars=trace["y"]))

    def columns(self, at: str, values: Array, dt: float, units: Mapping[str, str]) -> None:
        """Record the columns of an array as one entity; `units` by the names of the columns."""
        steps, width = values.shape
        names = [typeset(labelled(name, unit)) for name, unit in units.items()]
        colours = [SERIES[i % len(SERIES)] for i in range(width)]
        scalars = rr.Scalars.columns(scalars=np.ascontiguousarray(values).reshape(-1))
        middle = 0.5 * (dt - self.dt)  # of means over several steps
        look, times = rr.SeriesLines(colors=colours, names=names), np.arange(steps) * dt + middle
        self.send(at, look, times, scalars.partition([width] * steps))


# the views of the viewer


def camera(findings: Findings, body: Body) -> dict[str, Any]:
    """Return where the views look from, and their grid; y points up from above, z from the side.

    The camera sees the target, the best and the first run; others may diverge.
    """
    scene, shown = scene_of(findings.task.model), [findings.task.target]
    shown += [run.trial.states for run in (findings.best, findings.first) if run is not None]
    shown += [log.trial.states for log in findings.logs] if not findings.runs else []
    points = np.vstack([np.zeros((0, 3)), *(reach(body, states) for states in shown)])
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else np.zeros((2, 3))
    extent, up = max(float((high - low).max()), 1e-3), (0, 0, 1)
    direction = np.array([0.0, -1.0, 0.7 if scene.volume else 0.1])
    if not is_mechanism(body) and not scene.volume:
        direction, up = np.array([0.0, 0.0, 1.0]), (0, 1, 0)
    centre, aside = (low + high) / 2, direction / np.linalg.norm(direction)
    eye = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=centre + DISTANCE * extent * aside,
        look_target=centre,
        eye_up=up,
    )
    spacing = 10.0 ** np.floor(np.log10(extent / 2))
    grid = rrb.LineGrid3D(visible=True, spacing=spacing, color=(90, 90, 90, 60))
    return {"eye_controls": eye, "line_grid": grid}


def space(view: Mapping[str, Any], contents: Sequence[str], name: str) -> Any:
    """Return a view of some entities from a `camera`."""
    return rrb.Spatial3DView(origin="/", contents=list(contents), name=name, **view)


def blueprint(findings: Findings, body: Body) -> Any:
    """Return the views: overview, states, inputs, bias, forecasts, one tab per trial."""
    figures = over_time(findings)
    plots = {
        figure.name: [_plot(entity_of(figure, panel), panel.title) for panel in figure.panels]
        for figure in figures
    }

    # the overview: the answer above paths, summary and the first plots
    answer: Any = rrb.TextDocumentView(origin="/verdict", name="Diagnosis")
    words, view = rrb.TextDocumentView(origin="/summary", name="Summary"), camera(findings, body)
    left = rrb.Vertical(space(view, ["/paths/**"], "Paths"), words, row_shares=[3, 2])
    first = [plot for name, most in FIRST.items() for plot in plots.get(name, ())[:most]]
    both = rrb.Horizontal(left, rrb.Grid(*first, grid_columns=2), column_shares=[1, 1])
    tabs: list[Any] = [rrb.Vertical(answer, both, name="Overview", row_shares=[2, 5])]
    tabs += [rrb.Grid(*plots[one.name], name=one.title) for one in figures]
    tabs.append(rrb.Tabs(*_trials(findings, view), name="By trial"))
    return rrb.Blueprint(
        # a workspace of logs alone opens at the logs
        rrb.Tabs(*tabs, active_tab=0 if findings.runs or not findings.logs else len(tabs) - 1),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time"),
        auto_views=False,
        auto_layout=False,
    )


def _trials(findings: Findings, view: Mapping[str, Any]) -> list[Any]:
    """Return a tab for each of the latest trials and logs."""
    shown = [
        (f"/trials/{run.trial.id}", f"{run.label}, utility {figure(run.utility)}", run.explained)
        for run in findings.runs[-OTHERS:]
    ]
    shown += [
        (f"/data/{log.trial.id}", f"{log.trial.id}, data", None) for log in findings.logs[-OTHERS:]
    ]
    tabs = []
    for at, title, explained in shown:
        names = SIGNALS | ({} if explained is None else {"explained": "bias as diagnosed"})
        contents = ["/paths/desired", f"{at}/path", f"{at}/predicted/**", f"{at}/body/**"]
        plots = [_plot(f"{at}/{key}", name) for key, name in names.items()]
        path = space(view, contents, title)
        tabs.append(rrb.Horizontal(path, rrb.Vertical(*plots), name=at.split("/")[-1]))
    return tabs


def _plot(origin: str, name: str) -> Any:
    key = rrb.PlotLegend(corner=rrb.Corner2D.LeftTop)
    return rrb.TimeSeriesView(origin=origin, name=typeset(name), plot_legend=key)
