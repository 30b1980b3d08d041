"""Writes a workspace for the Rerun viewer, as one .rrd file. Only this module imports rerun.

    /paths/...                desired, the model's own policy, the best so far and its prediction
    /states, /inputs, /bias   the page's figures over time: a plot a panel, a curve an entity
    /forecast                 the same of a run and its predictions, restarted every second
    /ahead/...                the same in space: the run, effects off, effects on
    /trials/t0007/...         all of one trial: path, prediction, body, state, input, bias
    /data/t0003/...           the same for a log that ran no candidate
    /verdict, /credit         what to run next, why the model was wrong; the share of each cause
    /paths/crashes/t0007      where a run ended early
    /utilities, /summary      utility by iteration, and a summary in Markdown

There is one timeline, `time`, in seconds since the start of a trial. Numbers are logged as whole
columns, names and colours once. The file is derived from trials and may be deleted. All recordings
of one workspace have the same id, so that they can be merged (`rerun rrd merge`). `_Recorder`
writes the entities, `blueprint` places them in the viewer.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from grounded.figures.body import Body, Part
from grounded.figures.figure import COLOURS as PAGE
from grounded.figures.figure import Bars, Figure, Panel, rgb, typeset
from grounded.frozen import Array
from grounded.trial import Trial
from grounded_trials.plain_file import unwritable
from grounded_trials.report.bodies import body_in, is_mechanism, reach, scene_of
from grounded_trials.report.figures.gap import forecast_figures, forecast_run
from grounded_trials.report.figures.paths import crash, ended
from grounded_trials.report.figures.runs import (
    averaged,
    bias_figure,
    input_figure,
    state_figure,
    window_of,
)
from grounded_trials.report.findings import Findings, Run
from grounded_trials.report.forecast import forecast
from grounded_trials.report.tables import about, counted, improved
from grounded_trials.wording import figure, labelled, per_second

COLOURS = {role: rgb(dark) for role, (_, dark) in PAGE.items()}
COLOURS |= {"desired": (170, 170, 170), "other": (110, 110, 110), "model_policy": COLOURS["model"]}
SERIES = [COLOURS[role] for role in ("best", "limit", "accepted", "step2", "predicted", "model")]
FINE = 600  # steps above which the bias of a trial is averaged, to keep files small
FRAMES = 600  # largest number of poses of a body in an animation
VERTICES = 1000  # largest number of points of a path in space
ARM = 0.02  # half the size of a crash's cross, as a fraction of the path's size
LABELS = 6  # largest number of crashes whose labels are always shown; more show on hovering
CROSS = ((1, 1, 0), (1, -1, 0), (1, 0, 1), (1, 0, -1))  # seen from above, and from the side
DISTANCE = 1.1  # distance of the camera, times the size of the contents
TALL = 1.35  # the distance in a view that is higher than wide, times that
ASIDE = 1.5  # the same for a mechanism, whose parts have a width
TRIALS = 60  # largest number of trials with a tab of their own
SIGNALS = {"state": "states", "input": "inputs", "bias": "bias"}  # of a trial
FIRST = 4  # states in the overview; all of them have a tab
Colour = tuple[int, int, int]


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
    """Return the page's figures over time: states, inputs, bias, forecasts."""
    made = (state_figure(findings), input_figure(findings), bias_figure(findings))
    return [figure for figure in (*made, *forecast_figures(findings)[:1]) if figure is not None]


def escaped(name: str) -> str:
    """Return a name as a part of an entity's path."""
    return rr.new_entity_path([name]).removeprefix("/")


def entity_of(figure: Figure, panel: Panel | Bars) -> str:
    """Return the path of a panel's entities."""
    return f"/{figure.name}/{escaped(panel.title)}"


# texts


def texts(findings: Findings) -> dict[str, str]:
    """Return the texts of the recording by entity (Markdown)."""
    lines = [f"next: `{findings.next_command}`", *([] if findings.diagnosis else ["not diagnosed"])]
    verdict, said = "\n\n".join([*lines, *map(_marked, findings.lines)]), findings.told
    found = {"summary": _summary(findings), "verdict": verdict}
    if said is not None and said.rows:
        rows = (said.header, ("---",) * len(said.header), *said.rows)
        found["credit"] = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    return found


def _marked(text: str) -> str:
    """Return a text with ± and ², and with the names of tables as code: lines broke after [."""
    return str(typeset(re.sub(r"\[\w+\]", "`\\g<0>`", text)))


def _summary(findings: Findings) -> str:
    """Return a summary of the workspace and of what is left out."""
    colours = "grey: desired; orange: model's policy; blue: best so far; pink: its prediction"
    if findings.better is not None and findings.best is not None:
        colours += f"; yellow: limits, and the bias that the model {findings.better.name} leaves"
    if any(crash(run) is not None for run in findings.runs):
        colours += "; crosses: where and when a run ended early"
    lines = [
        f"**{findings.name}**, {about(findings)}; {'; '.join(counted(findings))}",
        *(f"{value}: {what}" for value, what in improved(findings)),
        colours,
        f"**{findings.standing.outcome}**: {_marked(findings.outlook)}",
        *(f"**left out**: {one.file}: {one.reason}" for one in findings.lost),
    ]
    return "\n\n".join(map(typeset, lines))


class _Recorder:
    """Records findings into a stream: methods for the contents first, then for single entities."""

    def __init__(self, stream: Any, findings: Findings, body: Body) -> None:
        self.stream, self.findings, self.body = stream, findings, body
        self.task, self.dt = findings.task, findings.task.dt

    def log(self, at: str, look: Any) -> None:
        """Record what holds at all times."""
        self.stream.log(at, look, static=True)

    def everything(self) -> None:
        findings = self.findings
        self.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        for name, text in texts(findings).items():
            self.log(name, rr.TextDocument(text, media_type="text/markdown"))
        values = [u for u in findings.standing.utilities if np.isfinite(u)]
        if values:
            self.log("utilities", rr.BarChart(values, color=COLOURS["best"]))
        self.paths()
        for drawn in over_time(findings):
            self.series(drawn)
        self.forecasts()
        for run in findings.runs:
            at = f"trials/{run.trial.id}"
            self.trial(at, run.trial, run.residual, self.colour(run), 2.0)
            self.ghost(f"{at}/predicted", run)
            if run.explained is not None:
                self.rates(f"{at}/explained", run.explained)
        self.crashes()
        for one in findings.logs:
            self.trial(f"data/{one.trial.id}", one.trial, one.residual, "best", 1.5)

    def paths(self) -> None:
        """Record the paths of the overview, with a body on each path that was run."""
        task, first, best = self.task, self.findings.first, self.findings.best
        if np.isfinite(self.body.path(task.target)).all():
            self.path("paths/desired", task.target, "desired", 2.0)
        waiting = self.findings.standing.outstanding
        if first is None and waiting is not None:
            self.path("paths/predicted", waiting.predicted_states, "predicted", 1.5)
        if first is not None:
            self.moving("paths/model_policy", first.trial, "model_policy")
        if best is not None and (first is None or best.candidate is not first.candidate):
            self.ghost("paths/predicted", best)
            self.moving("paths/best", best.trial, "best")

    def series(self, figure: Figure) -> None:
        """Record the curves, limits and marks of a figure over time."""
        for panel in figure.panels:
            if isinstance(panel, Bars):
                continue
            at, end = entity_of(figure, panel), max(np.nanmax(curve.x) for curve in panel.curves)
            for curve in panel.curves:
                place = f"{at}/{escaped(curve.name)}"
                self.line(place, curve.x, curve.y, curve.role, curve.name, curve.width)
            for rule in panel.rules:
                name = escaped(f"{rule.name} {rule.y:g}")
                self.line(f"{at}/{name}", np.array([0.0, end]), np.full(2, rule.y), rule.role)
            for k, dot in enumerate(panel.dots):
                self.marks(f"{at}/mark{k}", dot.x, np.array([dot.y]), COLOURS[dot.role], dot.note)

    def forecasts(self) -> None:
        """Record a run, and its forecasts by the model without effects and with them."""
        run, better = forecast_run(self.findings), self.findings.better
        if run is None or better is None:
            return
        self.moving("ahead/real", run.trial, "best")
        planners = {"off": (self.findings.crude, "model_policy")}
        planners["on"] = (better.planner, "predicted")
        for key, (planner, colour) in planners.items():
            found = forecast(planner, run.trial, self.findings.ahead_s)
            if found is not None:
                states = found.along(run.trial)
                self.moving(f"ahead/{key}", replace(run.trial, states=states), colour, width=1.5)

    def colour(self, run: Run) -> str:
        """Return the role of a run's colour in its own views."""
        compared = {"best": self.findings.best, "model_policy": self.findings.first}
        for role, chosen in compared.items():
            if chosen is not None and run.candidate is chosen.candidate:
                return role
        crashed = self.task.utility(run.trial) == -np.inf
        return "limit" if crashed else "accepted" if run.accepted else "other"

    def trial(self, at: str, trial: Trial, residual: Array, colour: str, width: float) -> None:
        """Record a trial under its own name: path, body, states, inputs and bias."""
        model = self.task.model
        self.moving(at, trial, colour, "/path", width)
        self.columns(f"{at}/state", trial.states, self.dt, model.states)
        self.columns(f"{at}/input", trial.inputs, self.dt, model.inputs)
        self.rates(f"{at}/bias", residual)

    def rates(self, at: str, residual: Array) -> None:
        """Record a residual (T, n) as rates; averaged if long or noisy."""
        window = max(window_of([column]) for column in residual.T)
        step = max(window, -(-len(residual) // FINE))
        units = {name: per_second(unit) for name, unit in self.task.model.states.items()}
        self.columns(at, averaged(residual, step) / self.dt, step * self.dt, units)

    def crashes(self) -> None:
        """Mark where and when runs ended early, in the overview and by trial."""
        points = self.body.path(self.task.target)
        points = points[np.isfinite(points).all(axis=1)]
        early = [run for run in self.findings.runs if crash(run) is not None]
        reached = [self.body.path(run.trial.states[: run.trial.finite_steps + 1]) for run in early]
        size = float(np.ptp(np.vstack([points, *reached]), axis=0).max()) if early else 0.0
        for run in early:
            name, note, last = run.trial.id, ended(run), run.trial.finite_steps
            place = self.body.path(run.trial.states[[last]])[0]
            if np.isfinite(place).all():
                lines = [[place - end, place + end] for end in ARM * size * np.array(CROSS)]
                look: Any = {"colors": COLOURS["model"], "radii": rr.Radius.ui_points(2)}
                look |= {"labels": [note, *[""] * (len(lines) - 1)]}
                few = len(early) <= LABELS
                for at, shown in ((f"paths/crashes/{name}", few), (f"trials/{name}/crash", True)):
                    self.log(at, rr.LineStrips3D(lines, show_labels=shown, **look))
            at, values = f"trials/{name}/state/ended", run.trial.states[last]
            self.marks(at, last * self.dt, values, COLOURS["model"], note)

    def marks(self, at: str, time: float, values: Array, colour: Colour, note: str) -> None:
        """Record values at one time as crosses with a note."""
        if not np.isfinite(values).all():
            return
        n = len(values)
        look: Any = {"colors": [colour] * n, "markers": ["cross"] * n, "marker_sizes": [5.0] * n}
        self.log(at, rr.SeriesPoints(names=[note] * n, **look))
        when = [rr.TimeColumn("time", duration=np.array([time]))]
        parts = rr.Scalars.columns(scalars=values).partition([n])
        self.stream.send_columns(at, when, parts)

    def ghost(self, at: str, run: Run) -> None:
        """Record the predicted run, with a body that moves alongside the real one."""
        states, inputs = run.candidate.predicted_states, run.candidate.predicted_inputs
        names = (run.trial.state_names, run.trial.input_names)
        if np.isfinite(states).all():
            self.moving(at, Trial(states, inputs, self.dt, *names), "predicted", width=1.0)
        else:
            self.path(at, states, "predicted", 1.0)

    def moving(
        self, at: str, trial: Trial, colour: str, path: str = "", width: float = 2.0
    ) -> None:
        """Record the path of a run, and the body that moves and turns along it."""
        self.path(at + path, trial.states, colour, width)
        rows = np.flatnonzero(np.isfinite(trial.states).all(axis=1))
        parts = self.body.parts
        rows = rows[:: max(1, len(rows) * len(parts) // FRAMES)]
        if not len(rows):
            return
        times = [rr.TimeColumn("time", duration=rows * self.dt)]
        poses = self.body.poses(trial.states[rows])
        for part, (origin, turned) in zip(parts, poses, strict=True):
            entity = f"{at}/body/{part.name}" if part.name else f"{at}/body"
            self.log(entity, drawn(part, COLOURS[colour], ghost=colour == "predicted"))
            pose = rr.Transform3D.columns(translation=origin, mat3x3=turned)
            self.stream.send_columns(entity, times, pose)

    def path(self, at: str, states: Array, colour: str, width: float) -> None:
        """Record a path in space as one static line."""
        points = self.body.path(states)
        points = points[np.isfinite(points).all(axis=1)]
        if len(points):
            few = points[np.unique(np.linspace(0, len(points) - 1, VERTICES).astype(int))]
            look: Any = {"colors": COLOURS[colour], "radii": rr.Radius.ui_points(width)}
            self.log(at, rr.LineStrips3D([few], **look))

    def line(
        self, at: str, times: Array, values: Array, role: str, name: str = "", width: float = 1.0
    ) -> None:
        """Record the finite values of a curve over time, named by default after its role."""
        self.log(at, rr.SeriesLines(colors=COLOURS[role], names=name or role, widths=width))
        keep = np.flatnonzero(np.isfinite(values))
        when = [rr.TimeColumn("time", duration=times[keep])]
        self.stream.send_columns(at, when, rr.Scalars.columns(scalars=values[keep]))

    def columns(self, at: str, values: Array, dt: float, units: Mapping[str, str]) -> None:
        """Record the columns of an array as one entity; `units` by the names of the columns."""
        steps, width = values.shape
        names = [typeset(labelled(name, unit)) for name, unit in units.items()]
        colours = [SERIES[i % len(SERIES)] for i in range(width)]
        self.log(at, rr.SeriesLines(colors=colours, names=names))
        scalars = rr.Scalars.columns(scalars=np.ascontiguousarray(values).reshape(-1))
        middle = 0.5 * (dt - self.dt)  # of means over several steps
        times = [rr.TimeColumn("time", duration=np.arange(steps) * dt + middle)]
        self.stream.send_columns(at, times, scalars.partition([width] * steps))


def drawn(part: Part, colour: Colour, ghost: bool = False) -> Any:
    """Return the archetype of a part in one colour; ghosts (predictions) as wireframes."""
    modes, size = rr.components.FillMode, part.size
    look: Any = {"colors": colour, "fill_mode": modes.MajorWireframe if ghost else modes.Solid}
    if part.shape == "box":
        return rr.Boxes3D(half_sizes=[size], **look)
    if part.shape == "ellipsoid":
        return rr.Ellipsoids3D(half_sizes=[size], **look)
    if part.shape in ("capsule", "cylinder"):
        kind = rr.Capsules3D if part.shape == "capsule" else rr.Cylinders3D
        return kind(radii=[size[0]], lengths=[size[1]], **look)
    if part.shape == "mesh":
        faces = part.faces.astype(np.uint32)
        return rr.Mesh3D(vertex_positions=part.points, triangle_indices=faces, albedo_factor=colour)
    if part.shape == "lines":
        return rr.LineStrips3D(part.strips, colors=colour, radii=rr.Radius.ui_points(2))
    return rr.Points3D([[0, 0, 0]], colors=colour, radii=rr.Radius.ui_points(6))


# the views of the viewer


class _Space:
    """Views of the space that a body moves in: paths from above, mechanisms from the side."""

    def __init__(self, findings: Findings, body: Body) -> None:
        self.scene, self.aside = scene_of(findings.task.model), is_mechanism(body)
        # others than target, best and first run may diverge and are left out
        shown = [findings.task.target]
        shown += [run.trial.states for run in (findings.best, findings.first) if run is not None]
        shown += [log.trial.states for log in findings.logs] if not findings.runs else []
        points = np.vstack([reach(body, states) for states in shown])
        low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else np.zeros((2, 3))
        self.centre, self.extent = (low + high) / 2, float((high - low).max() or 1.0)

    @property
    def title(self) -> str:
        """The title of the first view."""
        if self.aside:
            return "From the side"
        axes = [labelled(*one) for one in zip(self.scene.names, self.scene.units, strict=True)]
        return "Paths: " + " over ".join(reversed(axes)) if len(axes) == 2 else "Paths"

    def view(self, contents: Sequence[str], name: str, tall: bool = False) -> Any:
        """Return a view of some entities; y points up from above, z from the side.

        A `tall` view is higher than wide: the camera is farther away, since it sees less aside.
        """
        extent, up = max(self.extent, 1e-3), (0, 0, 1)
        if self.aside:
            direction = np.array([0.0, -1.0, 0.1])
        elif self.scene.volume:
            direction = np.array([0.0, -1.0, 0.7])
        else:
            direction, up = np.array([0.0, 0.0, 1.0]), (0, 1, 0)
        distance = extent * (ASIDE if self.aside else DISTANCE) * (TALL if tall else 1.0)
        eye = rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=self.centre + distance * direction / np.linalg.norm(direction),
            look_target=self.centre,
            eye_up=up,
        )
        spacing = 10.0 ** math.floor(math.log10(extent / 2))
        grid = rrb.LineGrid3D(visible=True, spacing=spacing, color=(90, 90, 90, 60))
        return rrb.Spatial3DView(
            origin="/", contents=list(contents), name=name, eye_controls=eye, line_grid=grid
        )


def blueprint(findings: Findings, body: Body) -> Any:
    """Return the views: overview, effects on and off, states, inputs, bias, one tab per trial."""
    figures, space = over_time(findings), _Space(findings, body)
    plots = {
        figure.name: [_plot(entity_of(figure, panel), panel.title) for panel in figure.panels]
        for figure in figures
    }

    # the answer: the verdict and, beside it, the credit
    answer: Any = rrb.TextDocumentView(origin="/verdict", name="Diagnosis")
    if findings.diagnosis is not None and findings.diagnosis.credit:
        worth = rrb.TextDocumentView(origin="/credit", name="Causes")
        answer = rrb.Horizontal(answer, worth, column_shares=[3, 2])
    heights = [1, 8] if findings.diagnosis is None else [2, 5]

    # the overview
    hidden = rrb.PlotLegend(visible=False)
    bars = rrb.BarChartView(origin="/utilities", name="Utility by iteration", plot_legend=hidden)
    words = rrb.TextDocumentView(origin="/summary", name="Summary")
    below = rrb.Horizontal(bars, words, column_shares=[1, 2])
    left = rrb.Vertical(space.view(["/paths/**"], space.title), below, row_shares=[3, 2])
    counts = {"states": FIRST, "inputs": 2, "bias": 2}
    first = [plot for name, most in counts.items() for plot in plots.get(name, ())[:most]]
    both = rrb.Horizontal(left, rrb.Grid(*first, grid_columns=2), column_shares=[1, 1])
    tabs: list[Any] = [rrb.Vertical(answer, both, name="Overview", row_shares=heights)]

    # a run and the model's forecasts, without effects and with them
    ahead = plots.pop("forecast", [])
    if findings.better is not None and (findings.runs or findings.logs):
        words_of = {"off": findings.plain, "on": f"model {findings.better.name}"}
        views = [
            space.view(["/ahead/real/**", f"/ahead/{k}/**"], f"{findings.ahead_s:.3g} s ahead: {w}")
            for k, w in words_of.items()
        ]
        grid = rrb.Grid(*ahead, grid_columns=3)
        tabs.append(rrb.Vertical(rrb.Horizontal(*views), grid, name="Effects off and on"))
    tabs += [rrb.Grid(*plots[one.name], name=one.title) for one in figures if one.name in plots]
    tabs.append(rrb.Tabs(*_trials(findings, space), name="By trial"))

    # a workspace of logs alone opens at the logs, with the answer above them
    only_logs = bool(findings.logs) and not findings.runs
    shown: Any = rrb.Tabs(*tabs, active_tab=len(tabs) - 1 if only_logs else 0)
    if only_logs:
        shown = rrb.Vertical(answer, shown, row_shares=heights)
    return rrb.Blueprint(
        shown,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time"),
        auto_views=False,
        auto_layout=False,
    )


def _trials(findings: Findings, space: _Space) -> list[Any]:
    """Return a tab for each of the latest trials and logs."""
    shown = []
    for run in findings.runs[-TRIALS:]:
        names = dict(SIGNALS)
        if run.explained is not None:
            names["explained"] = "bias as diagnosed"
        title = f"{run.label}, utility {figure(run.utility)}"
        drawn = ["path", "predicted/**", "body/**", "crash"]
        shown.append((f"/trials/{run.trial.id}", title, names, drawn))
    for log in findings.logs[-TRIALS:]:
        title = f"{log.trial.id}, data"
        shown.append((f"/data/{log.trial.id}", title, SIGNALS, ["path", "body/**"]))
    tabs = []
    for at, title, names, drawn in shown:
        contents = ["/paths/desired", *(f"{at}/{part}" for part in drawn)]
        plots = [_plot(f"{at}/{key}", name) for key, name in names.items()]
        view = space.view(contents, title, tall=True)
        tabs.append(rrb.Horizontal(view, rrb.Vertical(*plots), name=at.split("/")[-1]))
    return tabs


def _plot(origin: str, name: str) -> Any:
    key = rrb.PlotLegend(corner=rrb.Corner2D.LeftTop)
    return rrb.TimeSeriesView(origin=origin, name=typeset(name), plot_legend=key)
