"""The recording: a workspace for the Rerun viewer, one .rrd file. Only `recording*` imports rerun.

    /paths/...                desired, the model's own policy, the best so far and its prediction
    /state/x/...              the same over time, a plot a state;  /input/u/...  with their limits
    /bias/x/...               what the crude model lacks along the run [unit/s], by iteration
    /trials/t0007/...         everything of one trial: path, prediction, body, state, input, bias
    /data/t0003/...           the same of a log that ran no candidate
    /utilities, /summary      by iteration, and in words

One timeline, `time`, in seconds since the start of a trial. Numbers go in by whole columns, names
and colours once. A file is derived from trials: it may be deleted, and files of single trials of
one workspace merge into one recording (`rerun rrd merge`), for their identity is the same.

The recording's summary, in Markdown.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from grounded.errors import GroundedError, needs
from grounded.frozen import Array
from grounded.trial import Trial
from grounded_trials.report.findings import Findings, Log, Run, selection, tracked
from grounded_trials.report.recording import marks
from grounded_trials.report.recording.layout import blueprint
from grounded_trials.report.scene import Scene, scene_of
from grounded_trials.wording import count, labelled, per_second

ITERATIONS = 4  # of the bias, in one plot
FINE = 600  # steps; the bias of longer trials is averaged over a few steps, or files get large


def write_recording(findings: Findings, path: Path) -> None:
    """Writes the .rrd file of a workspace.

    Raises:
        GroundedError: if it can't be written, or rerun is not installed.
    """
    rr = needs("rerun", "view")
    rr.set_strict_mode(True)
    identity = hashlib.sha256(f"{findings.name} {findings.task.hash}".encode()).hexdigest()[:32]
    stream = rr.RecordingStream("grounded", recording_id=identity)
    scene = scene_of(findings.task.model)
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        stream.save(temporary, default_blueprint=blueprint(findings, scene))
        stream.send_recording_name(findings.name)
        _everything(stream, findings, scene)
        stream.flush()
        stream.disconnect()
        temporary.replace(path)
    except (OSError, RuntimeError) as error:
        raise GroundedError(f"{path} can't be written: {error}") from None
    finally:
        temporary.unlink(missing_ok=True)


def _everything(stream: Any, findings: Findings, scene: Scene) -> None:
    import rerun as rr

    stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log(
        "summary", rr.TextDocument(summary(findings), media_type="text/markdown"), static=True
    )
    values = [u for u in findings.standing.utilities if np.isfinite(u)]
    if values:
        stream.log("utilities", rr.BarChart(values, color=marks.COLOURS["best"]), static=True)
    _paths(stream, findings, scene)
    _compared(stream, findings)
    _biases(stream, findings)
    for run in findings.runs:
        _trial(stream, findings, scene, run)
    for log in findings.logs:
        _log(stream, findings, scene, log)


def _paths(stream: Any, findings: Findings, scene: Scene) -> None:
    """The paths that one wants to see first, with a body on each that was really run."""
    task, first, best = findings.task, findings.first, findings.best
    if all(np.isfinite(task.target[:, i]).all() for i in scene.axes):
        marks.path(stream, "paths/desired", scene.points(task.target), "desired", 2.0)
    shown = {"model_policy": first}
    waiting = findings.standing.outstanding
    if first is None and waiting is not None:
        planned = scene.points(waiting.predicted_states)
        marks.path(stream, "paths/predicted", planned, "predicted", 1.5)
    if best is not None and (first is None or best.candidate is not first.candidate):
        predicted = scene.points(best.candidate.predicted_states)
        marks.path(stream, "paths/predicted", predicted, "predicted", 1.0)
        shown["best"] = best
    for role, run in shown.items():
        if run is not None:
            _moving(stream, findings, scene, f"paths/{role}", run, role)


def _moving(
    stream: Any, findings: Findings, scene: Scene, at: str, run: Run, colour: str, path: str = ""
) -> None:
    """A path that was run, and the body that moves along it."""
    states, size = run.trial.states, _size(findings, scene)
    marks.path(stream, at + path, scene.points(states), colour, 2.0)
    marks.body(stream, f"{at}/body", scene, states, findings.task.dt, size, colour)


def _compared(stream: Any, findings: Findings) -> None:
    """States and inputs over time, a plot each: target and limits beside what was run."""
    task, best = findings.task, findings.best
    known = tracked(task)
    for i, name in enumerate(task.model.state_names):
        if i in known:
            marks.line(stream, f"state/{name}/desired", task.target[:, i], task.dt, "desired")
        _runs(stream, findings, f"state/{name}", "states", i)
        if best is not None:
            predicted = best.candidate.predicted_states[:, i]
            marks.line(stream, f"state/{name}/predicted", predicted, task.dt, "predicted", width=1)
    for j, name in enumerate(task.model.input_names):
        _runs(stream, findings, f"input/{name}", "inputs", j)
        for bound, limit in (("low", task.low[j]), ("high", task.high[j])):
            if np.isfinite(limit):
                span, whole = np.full(2, limit), task.dt * task.horizon
                marks.line(stream, f"input/{name}/{bound}", span, whole, "limit", width=1)


def _runs(stream: Any, findings: Findings, at: str, kind: str, column: int) -> None:
    """One quantity along the model's policy and along the best so far."""
    for role, run in (("model_policy", findings.first), ("best", findings.best)):
        if run is not None:
            name, width = _words(role, run), 3.0 if role == "best" else 1.5
            values = getattr(run.trial, kind)[:, column]
            marks.line(stream, f"{at}/{role}", values, findings.task.dt, role, name, width)


def _biases(stream: Any, findings: Findings) -> None:
    """What the crude model lacks, by iteration; and what the diagnosed effects leave of it."""
    best = findings.best
    shown = selection(findings.improvements, ITERATIONS)
    colours = ["model_policy", "accepted", "other", "best"]
    for number, run in enumerate(shown):
        last = number == len(shown) - 1 and number > 0
        key = f"iteration {run.candidate.iteration}"
        colour = "best" if last else colours[number % 3]
        _rates(stream, findings, key, run.residual, colour)
    if best is not None and best.explained is not None and findings.better is not None:
        _rates(stream, findings, f"left, {findings.better.name}", best.explained, "limit")


def _rates(stream: Any, findings: Findings, key: str, residual: Array, colour: str) -> None:
    rates, dt = rate(residual, findings.task.dt)
    for i, name in enumerate(findings.task.model.state_names):
        at = f"bias/{name}/{key.replace(' ', '_').replace(',', '')}"
        marks.line(stream, at, rates[:, i], dt, colour, key, 1.0)


def rate(residual: Array, dt: float) -> tuple[Array, float]:
    """What a model lacks per second (T, n), and its interval: means of a few steps for large T."""
    step = -(-len(residual) // FINE)
    if step <= 1:
        return residual / dt, dt
    whole = residual[: len(residual) // step * step]
    return whole.reshape(-1, step, residual.shape[1]).mean(axis=1) / dt, step * dt


def _trial(stream: Any, findings: Findings, scene: Scene, run: Run) -> None:
    """Everything of one trial, under its own name."""
    task, at = findings.task, f"trials/{run.trial.id}"
    colour = "accepted" if run.accepted else "other"
    for role, chosen in (("model_policy", findings.first), ("best", findings.best)):
        if chosen is not None and run.candidate is chosen.candidate:
            colour = role
    _moving(stream, findings, scene, at, run, colour, "/path")
    predicted = scene.points(run.candidate.predicted_states)
    marks.path(stream, f"{at}/predicted", predicted, "predicted", 1.0)
    _signals(stream, findings, at, run.trial, run.residual)
    if run.explained is not None:
        rates = [labelled(n, per_second(u)) for n, u in task.model.states.items()]
        marks.columns(stream, f"{at}/explained", *rate(run.explained, task.dt), rates)


def _log(stream: Any, findings: Findings, scene: Scene, log: Log) -> None:
    """A log that ran no candidate, and the model set on it anew every second."""
    task, at, trial = findings.task, f"data/{log.trial.id}", log.trial
    size = _size(findings, scene)
    marks.path(stream, f"{at}/path", scene.points(trial.states), "best", 1.5)
    marks.body(stream, f"{at}/body", scene, trial.states, task.dt, size, "best")
    _signals(stream, findings, at, trial, log.residual)


def _signals(stream: Any, findings: Findings, at: str, trial: Trial, residual: Array) -> None:
    """States, inputs and bias, each as one entity with named columns."""
    model, dt = findings.task.model, findings.task.dt
    states = [labelled(n, u) for n, u in model.states.items()]
    inputs = [labelled(n, u) for n, u in model.inputs.items()]
    rates = [labelled(n, per_second(u)) for n, u in model.states.items()]
    marks.columns(stream, f"{at}/state", trial.states, dt, states)
    marks.columns(stream, f"{at}/input", trial.inputs, dt, inputs)
    marks.columns(stream, f"{at}/bias", *rate(residual, dt), rates)


def _words(role: str, run: Run) -> str:
    return ("the model's policy" if role == "model_policy" else "best so far") + f", {run.label}"


def _size(findings: Findings, scene: Scene) -> float:
    """The length of a body that can be seen beside the path."""
    shown = findings.runs or findings.logs
    states = shown[0].trial.states if shown else findings.task.target
    points = scene.points(states)
    points = points[np.isfinite(points).all(axis=1)]
    return 0.07 * (float(np.ptp(points, axis=0).max()) or 1.0) if len(points) else 0.07


def summary(findings: Findings) -> str:
    """What was learnt, what is lost, what to do next."""
    task, best, first = findings.task, findings.best, findings.first
    lines = [
        f"# {findings.name}",
        f"{task.model.name}: {task.horizon} steps of {task.dt:g} s, "
        f"{count(len(findings.runs), 'trial')}, {count(len(findings.logs), 'log')} of data",
        "",
        "| | candidate | utility |",
        "|---|---|---|",
    ]
    if first is not None:
        lines.append(f"| the model's policy | {first.candidate.id} | {first.utility:.4g} |")
    if best is not None:
        lines.append(f"| best so far | {best.candidate.id} | {best.utility:.4g} |")
    if findings.optimum is not None:
        lines.append(f"| optimum | | {findings.optimum:.4g} |")
    lines += ["", "grey: desired; orange: model's policy; blue: best so far; pink: its prediction"]
    lines += ["", f"**{findings.standing.phase}**: {findings.standing.sentence}", ""]
    if findings.diagnosis is not None:
        lines += [f"**diagnosis**: {findings.diagnosis.sentence}", ""]
    lines += [f"**left out**: {one.file}: {one.reason}\n" for one in findings.lost]
    lines.append(f"next: `{findings.next_command}`")
    return "\n".join(lines)
