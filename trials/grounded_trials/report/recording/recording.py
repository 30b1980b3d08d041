"""Writes a workspace for the Rerun viewer, as one .rrd file.

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
of one workspace have the same id, so that they can be merged (`rerun rrd merge`).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from grounded.figures.body import Body, Part
from grounded.figures.figure import COLOURS as PAGE
from grounded.figures.figure import Bars, Figure, rgb, typeset
from grounded.frozen import Array
from grounded.trial import Trial
from grounded_trials.plain_file import unwritable
from grounded_trials.report.bodies import body_in
from grounded_trials.report.calmed import averaged, window_of
from grounded_trials.report.figures.gap import forecast_run
from grounded_trials.report.figures.paths import crash, ended
from grounded_trials.report.findings import Findings, Run
from grounded_trials.report.forecast import forecast
from grounded_trials.report.recording.layout import Space, blueprint, entity_of, escaped, over_time
from grounded_trials.report.scene import scene_of
from grounded_trials.report.tables import about, counted, improved
from grounded_trials.wording import labelled, per_second


def verdict(findings: Findings) -> str:
    """Return the next command, and the diagnosis in a few lines (Markdown)."""
    lines = [f"next: `{findings.next_command}`", *([] if findings.diagnosis else ["not diagnosed"])]
    return "\n\n".join([*lines, *map(_marked, findings.lines)])


def credit(findings: Findings) -> str:
    """Return the causes as a table (Markdown); "" if there is none."""
    said = findings.told
    if said is None or not said.rows:
        return ""
    rows = (said.header, ("---",) * len(said.header), *said.rows)
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _marked(text: str) -> str:
    """Return a text with ± and ², and with the names of tables as code: lines broke after [."""
    return str(typeset(re.sub(r"\[\w+\]", "`\\g<0>`", text)))


def summary(findings: Findings) -> str:
    """Return a summary of the workspace and of what is left out (Markdown)."""
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


COLOURS = {role: rgb(dark) for role, (_, dark) in PAGE.items()}
COLOURS |= {"desired": (170, 170, 170), "other": (110, 110, 110), "model_policy": COLOURS["model"]}
SERIES = [COLOURS[role] for role in ("best", "limit", "accepted", "step2", "predicted", "model")]
FINE = 600  # steps above which the bias of a trial is averaged, to keep files small
Colour = tuple[int, int, int]
FRAMES = 600  # largest number of poses of a body in an animation
VERTICES = 1000  # largest number of points of a path in space
ARM = 0.02  # half the size of a crash's cross, as a fraction of the path's size
LABELS = 6  # largest number of crashes whose labels are always shown; more show on hovering
CROSS = ((1, 1, 0), (1, -1, 0), (1, 0, 1), (1, 0, -1))  # seen from above, and from the side


def write_recording(findings: Findings, path: Path) -> None:
    """Write the .rrd file of a workspace.

    Raises:
        GroundedError: if it can't be written, or rerun is not installed.
    """
    rr.set_strict_mode(True)
    identity = hashlib.sha256(f"{findings.name} {findings.task.hash}".encode()).hexdigest()[:32]
    stream = rr.RecordingStream("grounded", recording_id=identity)
    scene, body = scene_of(findings.task.model), body_in(findings)
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        stream.save(temporary, default_blueprint=blueprint(findings, Space(findings, scene, body)))
        stream.send_recording_name(findings.name)
        _Recorder(stream, findings, body).everything()
        stream.flush()
        stream.disconnect()
        temporary.replace(path)
    except (OSError, RuntimeError) as error:
        raise unwritable(path, error) from None
    finally:
        temporary.unlink(missing_ok=True)


class _Recorder:
    """Records findings into a stream: methods for the contents first, then for single entities."""

    def __init__(self, stream: Any, findings: Findings, body: Body) -> None:
        self.stream, self.findings, self.body = stream, findings, body
        self.task, self.dt = findings.task, findings.task.dt
        self.compared = {"model_policy": findings.first, "best": findings.best}
        self.per_second = {n: per_second(u) for n, u in findings.task.model.states.items()}

    def everything(self) -> None:
        log, findings = self.stream.log, self.findings
        log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        log("summary", rr.TextDocument(summary(findings), media_type="text/markdown"), static=True)
        for name, text in (("verdict", verdict(findings)), ("credit", credit(findings))):
            if text:
                log(name, rr.TextDocument(text, media_type="text/markdown"), static=True)
        values = [u for u in findings.standing.utilities if np.isfinite(u)]
        if values:
            log("utilities", rr.BarChart(values, color=COLOURS["best"]), static=True)
        self.paths()
        for drawn in over_time(findings):
            self.series(drawn)
        self.forecasts()
        for run in findings.runs:
            self.trial(run)
        self.crashes()
        for one in findings.logs:
            self.moving(f"data/{one.trial.id}", one.trial, "best", "/path", 1.5)
            self.signals(f"data/{one.trial.id}", one.trial, one.residual)

    def paths(self) -> None:
        """Record the paths of the overview, with a body on each path that was run."""
        task, first, best = self.task, self.findings.first, self.findings.best
        if np.isfinite(self.body.path(task.target)).all():
            self.path("paths/desired", task.target, "desired", 2.0)
        waiting = self.findings.standing.outstanding
        if first is None and waiting is not None:
            self.path("paths/predicted", waiting.predicted_states, "predicted", 1.5)
        shown = [("model_policy", first)]
        if best is not None and (first is None or best.candidate is not first.candidate):
            self.ghost("paths/predicted", best)
            shown.append(("best", best))
        for role, run in shown:
            if run is not None:
                self.moving(f"paths/{role}", run.trial, role)

    def series(self, figure: Figure) -> None:
        """Record the curves, limits and marks of a figure over time."""
        for panel in figure.panels:
            if isinstance(panel, Bars):
                continue
            at, ends = entity_of(figure, panel), [np.nanmax(curve.x) for curve in panel.curves]
            for curve in panel.curves:
                place = f"{at}/{escaped(curve.name)}"
                self.line(place, curve.x, curve.y, curve.role, curve.name, curve.width)
            for rule in panel.rules:
                span, level = np.array([0.0, max(ends)]), np.full(2, rule.y)
                self.line(f"{at}/{escaped(f'{rule.name} {rule.y:g}')}", span, level, rule.role)
            for k, dot in enumerate(panel.dots):
                self.marks(f"{at}/mark{k}", dot.x, np.array([dot.y]), COLOURS[dot.role], dot.note)

    def forecasts(self) -> None:
        """Record a run, and its forecasts by the model without effects and with them."""
        run = forecast_run(self.findings)
        if run is None or self.findings.better is None:
            return
        self.moving("ahead/real", run.trial, "best")
        for key, planner, colour in (
            ("off", self.findings.crude, "model_policy"),
            ("on", self.findings.better.planner, "predicted"),
        ):
            found = forecast(planner, run.trial, self.findings.ahead_s)
            if found is None:
                continue
            states = found.along(run.trial)
            self.moving(f"ahead/{key}", replace(run.trial, states=states), colour, width=1.5)

    def trial(self, run: Run) -> None:
        """Record all of one trial under its own name."""
        at, colour = f"trials/{run.trial.id}", "accepted" if run.accepted else "other"
        if self.task.utility(run.trial) == -np.inf:
            colour = "limit"  # crashed
        for role, chosen in self.compared.items():
            if chosen is not None and run.candidate is chosen.candidate:
                colour = role
        self.moving(at, run.trial, colour, "/path")
        self.ghost(f"{at}/predicted", run)
        self.signals(at, run.trial, run.residual)
        if run.explained is not None:
            self.columns(f"{at}/explained", *rate(run.explained, self.dt), self.per_second)

    def crashes(self) -> None:
        """Mark where and when runs ended early, in the overview and by trial."""
        points = self.body.path(self.task.target)
        points = points[np.isfinite(points).all(axis=1)]
        early = [run for run in self.findings.runs if crash(run) is not None]
        reached = [self.body.path(run.trial.states[: run.trial.finite_steps + 1]) for run in early]
        size = float(np.ptp(np.vstack([points, *reached]), axis=0).max()) if early else 0.0
        for run in early:
            name, few = run.trial.id, len(early) <= LABELS
            self.cross(f"paths/crashes/{name}", run, ARM * size, few)
            self.cross(f"trials/{name}/crash", run, ARM * size, True)
            at, last = f"trials/{name}/state/ended", run.trial.finite_steps
            values = run.trial.states[last]
            self.marks(at, last * self.dt, values, COLOURS["model"], ended(run))

    def cross(self, at: str, run: Run, arm: float, labelled: bool) -> None:
        """Record a cross where a run ended early, with a label to see or to hover over."""
        last = crash(run)
        place = None if last is None else self.body.path(run.trial.states[[last]])[0]
        if place is None or not np.isfinite(place).all():
            return
        lines = [[place - end, place + end] for end in arm * np.array(CROSS)]
        labels = [ended(run), *[""] * (len(lines) - 1)]
        look = {"colors": COLOURS["model"], "radii": rr.Radius.ui_points(2)}
        strips = rr.LineStrips3D(lines, labels=labels, show_labels=labelled, **look)
        self.stream.log(at, strips, static=True)

    def marks(self, at: str, time: float, values: Array, colour: Colour, note: str) -> None:
        """Record values at one time as crosses with a note."""
        if not np.isfinite(values).all():
            return
        look = rr.SeriesPoints(
            colors=[colour] * len(values),
            markers=["cross"] * len(values),
            marker_sizes=[5.0] * len(values),
            names=[note] * len(values),
        )
        self.stream.log(at, look, static=True)
        when = [rr.TimeColumn("time", duration=np.array([time]))]
        parts = rr.Scalars.columns(scalars=values).partition([len(values)])
        self.stream.send_columns(at, when, parts)

    def signals(self, at: str, trial: Trial, residual: Array) -> None:
        """Record states, inputs and bias, each as one entity with named columns."""
        model = self.task.model
        self.columns(f"{at}/state", trial.states, self.dt, model.states)
        self.columns(f"{at}/input", trial.inputs, self.dt, model.inputs)
        self.columns(f"{at}/bias", *rate(residual, self.dt), self.per_second)

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
            look = drawn(part, COLOURS[colour], ghost=colour == "predicted")
            self.stream.log(entity, look, static=True)
            pose = rr.Transform3D.columns(translation=origin, mat3x3=turned)
            self.stream.send_columns(entity, times, pose)

    def path(self, at: str, states: Array, colour: str, width: float) -> None:
        """Record a path in space as one static line."""
        points = self.body.path(states)
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            return
        points = points[np.unique(np.linspace(0, len(points) - 1, VERTICES).astype(int))]
        strip = rr.LineStrips3D([points], colors=COLOURS[colour], radii=rr.Radius.ui_points(width))
        self.stream.log(at, strip, static=True)

    def line(
        self, at: str, times: Array, values: Array, role: str, name: str = "", width: float = 1.0
    ) -> None:
        """Record the finite values of a curve over time, named by default after its role."""
        style = rr.SeriesLines(colors=COLOURS[role], names=name or role, widths=width)
        self.stream.log(at, style, static=True)
        keep = np.flatnonzero(np.isfinite(values))
        when = [rr.TimeColumn("time", duration=times[keep])]
        self.stream.send_columns(at, when, rr.Scalars.columns(scalars=values[keep]))

    def columns(self, at: str, values: Array, dt: float, units: Mapping[str, str]) -> None:
        """Record the columns of an array as one entity; `units` by the names of the columns."""
        steps, width = values.shape
        names = [typeset(labelled(name, unit)) for name, unit in units.items()]
        colours = [SERIES[i % len(SERIES)] for i in range(width)]
        self.stream.log(at, rr.SeriesLines(colors=colours, names=names), static=True)
        scalars = rr.Scalars.columns(scalars=np.ascontiguousarray(values).reshape(-1))
        middle = 0.5 * (dt - self.dt)  # of means over several steps
        times = [rr.TimeColumn("time", duration=np.arange(steps) * dt + middle)]
        self.stream.send_columns(at, times, scalars.partition([width] * steps))


def rate(residual: Array, dt: float) -> tuple[Array, float]:
    """Return a residual per second (T, n) and its interval [s]; averaged if long or noisy."""
    window = max(window_of([column]) for column in residual.T)
    step = max(window, -(-len(residual) // FINE))
    return averaged(residual, step) / dt, step * dt


def drawn(part: Part, colour: Colour, ghost: bool = False) -> Any:
    """Return the archetype of a part in one colour; ghosts (predictions) as wireframes."""
    modes, size = rr.components.FillMode, part.size
    look = modes.MajorWireframe if ghost else modes.Solid
    if part.shape == "box":
        return rr.Boxes3D(half_sizes=[size], colors=colour, fill_mode=look)
    if part.shape == "ellipsoid":
        return rr.Ellipsoids3D(half_sizes=[size], colors=colour, fill_mode=look)
    if part.shape == "capsule":
        return rr.Capsules3D(radii=[size[0]], lengths=[size[1]], colors=colour, fill_mode=look)
    if part.shape == "cylinder":
        return rr.Cylinders3D(radii=[size[0]], lengths=[size[1]], colors=colour, fill_mode=look)
    if part.shape == "mesh":
        faces = part.faces.astype(np.uint32)
        return rr.Mesh3D(vertex_positions=part.points, triangle_indices=faces, albedo_factor=colour)
    if part.shape == "lines":
        return rr.LineStrips3D(part.strips, colors=colour, radii=rr.Radius.ui_points(2))
    return rr.Points3D([[0, 0, 0]], colors=colour, radii=rr.Radius.ui_points(6))
