"""Where the runs went: paths in the plane, the error as their colour, deviations enlarged."""

from __future__ import annotations

import numpy as np

from grounded.figures.figure import WIDTHS, Curve, Dot, Figure, Panel, enlarging, legend
from grounded.frozen import Array
from grounded_trials.report.findings import Findings, Log, Run, compared, tracked, tracking_error
from grounded_trials.report.scene import Scene, scene_of
from grounded_trials.wording import labelled

OTHERS = 60  # runs that are drawn behind the compared ones
LOGS = 4  # that are drawn where there is no run
LOG_ROLES = ("best", "model", "accepted", "limit")
SEEN = 5.0  # the least factor that shows more than the paths themselves
FAR = 0.4  # of the desired path's size: enlarged deviations beyond it are not drawn


def path_figure(findings: Findings) -> Figure | None:
    """The paths in the plane, the error along the best one, and the deviations enlarged."""
    scene = scene_of(findings.task.model)
    if len(scene.axes) == 2 and not findings.runs and findings.logs:
        return _of_logs(findings, scene)
    if len(scene.axes) < 2 or len(named_paths(findings)) < 2:
        return None
    panels = [_plane(findings, scene, scene.axes[0], scene.axes[1], plan=True)]
    if scene.volume:
        panels.append(_plane(findings, scene, scene.axes[0], scene.axes[2], plan=False))
    panels += _enlarged(findings, scene) + _shaded(findings, scene)
    caption = "" if scene.spatial else f"No plane among the roles: {' and '.join(scene.names)}."
    if any(crash(run) for run in findings.runs):
        caption += " A cross marks where a run ended early."
    return Figure("paths", "Paths", caption.strip(), tuple(panels), legend(panels[:1]))


def _of_logs(findings: Findings, scene: Scene) -> Figure:
    """Where the robot went in the logs, while no candidate has been run."""
    x_name, y_name = (labelled(*one) for one in zip(scene.names, scene.units, strict=True))
    curves = []
    for k, log in enumerate(findings.logs[-LOGS:]):
        x, y = (log.trial.states[:, i] for i in scene.axes)
        times = np.arange(len(x), dtype=np.float64) * log.trial.dt
        curves.append(Curve(x, y, LOG_ROLES[k], log.trial.id, 1.5, times, trial=log.trial.id))
    equal = scene.spatial and len(set(scene.units)) == 1
    panel = Panel(
        f"{y_name} over {x_name}", x_name, y_name, tuple(curves), equal=equal, kind="path"
    )
    return Figure("paths", "Paths", "Data that ran no candidate.", (panel,), legend([panel]))


def name_of(role: str, run: Run) -> str:
    """Of a compared run in a legend."""
    return f"{'model’s policy' if role == 'model' else 'best so far'}, {run.label}"


def named_paths(findings: Findings) -> list[tuple[str, str, Array]]:
    """(role, name, states) of what is compared, first what lies behind."""
    found = [(role, name_of(role, run), run.trial.states) for role, run in compared(findings)]
    waiting = findings.standing.outstanding
    if not found and waiting is not None:
        found = [("predicted", f"predicted for {waiting.id}", waiting.predicted_states)]
    return [*found, ("desired", "desired", findings.task.target)]


def crash(run: Run | Log) -> int | None:
    """The step after which a run has no more data; None where it went to its end."""
    last = run.trial.finite_steps
    short = isinstance(run, Run) and (not np.isfinite(run.utility) or last < run.trial.steps)
    return last if short else None


def _plane(findings: Findings, scene: Scene, a: int, b: int, plan: bool) -> Panel:
    """Every run's path by name, the compared ones before the others, and what was predicted."""
    task = findings.task
    shown = {run.trial.id: (role, run) for role, run in compared(findings)}
    others = [r for r in findings.runs if r.trial.id not in shown][-OTHERS:]
    times: Array = np.arange(task.horizon + 1, dtype=np.float64) * task.dt

    def curve(states: Array, role: str, name: str, trial: str, style: str = "line") -> Curve:
        x, y, width = states[:, a], states[:, b], WIDTHS.get(role, 1.5)
        width = 0.8 if role == "other" else width
        return Curve(x, y, role, name, width, times[: len(states)], trial=trial, style=style)

    runs = [("other", r.label, r) for r in others]
    runs += [(role, name_of(role, r), r) for role, r in shown.values()]
    curves = [curve(r.trial.states, role, name, r.trial.id) for role, name, r in runs]
    curves += [
        curve(
            r.candidate.predicted_states,
            "predicted",
            f"predicted for {r.candidate.id}",
            r.trial.id,
            "ghost",
        )
        for _, _, r in runs
        if plan
    ]
    for role, name, states in named_paths(findings):
        if role in ("predicted", "desired"):
            curves.append(curve(states, role, name, ""))
    dots = [d for _, _, r in runs for d in _crash_mark(r, a, b, task.dt)]
    (x_name, x_unit), (y_name, y_unit) = (list(task.model.states.items())[i] for i in (a, b))
    names = labelled(x_name, x_unit), labelled(y_name, y_unit)
    equal = plan and x_unit == y_unit and scene.spatial
    title = f"{y_name} over {x_name}"
    return Panel(title, *names, tuple(curves), tuple(dots), equal=equal, kind="path")


def _crash_mark(run: Run, a: int, b: int, dt: float) -> list[Dot]:
    last = crash(run)
    if last is None:
        return []
    x, y = (float(run.trial.states[last, i]) for i in (a, b))
    note = f"{run.label} ended after {last * dt:.2f} s of {run.trial.steps * dt:.2f} s"
    return [Dot(x, y, "model", note, "cross", trial=run.trial.id)] if np.isfinite(x + y) else []


def _enlarged(findings: Findings, scene: Scene) -> list[Panel]:
    """The compared paths as many times as far from the desired one, where one can't see it."""
    axes = list(scene.axes[:2])
    if not (scene.spatial and set(axes) <= set(tracked(findings.task)) and findings.runs):
        return []
    desired = findings.task.target[:, axes]
    best = compared(findings)[-1][1].trial.states[:, axes]
    factor = enlarging(best, desired)
    if factor < SEEN:
        return []
    curves, cut = [], False
    for role, name, states in named_paths(findings):
        near = desired[: len(states)]
        path = near + factor * (states[:, axes] - near)
        off = np.abs(path - near).max(axis=1) > FAR * np.ptp(desired, axis=0).max()
        path[off] = np.nan
        cut |= bool(off.any())
        width = WIDTHS.get(role, 1.5)
        curves.append(Curve(path[:, 0], path[:, 1], role, name, width))
    x_name, y_name, *_ = (labelled(*one) for one in zip(scene.names, scene.units, strict=True))
    title = f"Deviations {factor:g} times as large"
    title += ", where they fit" * cut
    return [Panel(title, x_name, y_name, tuple(curves), equal=True, kind="path")]


def _shaded(findings: Findings, scene: Scene) -> list[Panel]:
    """The best path, its distance from where it should have been as its colour."""
    task, axes = findings.task, list(scene.axes)
    if not (scene.spatial and findings.runs and set(axes) <= set(tracked(task))):
        return []
    _, run = compared(findings)[-1]
    far = np.linalg.norm(tracking_error(task, run.trial)[:, axes], axis=1)
    name = labelled("distance from desired", scene.units[0])
    states, target = run.trial.states, task.target
    times: Array = np.arange(len(states), dtype=np.float64) * task.dt
    a, b = axes[:2]
    path = Curve(states[:, a], states[:, b], "other", "", 1.0, times, far, name)
    desired = Curve(target[:, a], target[:, b], "desired", "desired", 1.0)
    x_name, y_name, *_ = (labelled(*one) for one in zip(scene.names, scene.units, strict=True))
    title = f"Where {run.label} is off"
    return [Panel(title, x_name, y_name, (path, desired), equal=True, kind="path")]
