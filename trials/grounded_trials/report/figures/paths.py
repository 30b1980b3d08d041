"""Figures of paths: the runs in the plane.

A mechanism without a position in the plane is drawn from the side, with the path of its end.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from grounded.figures import (
    WIDTHS,
    Figure,
    Trace,
    curve,
    marks,
    panel,
)
from grounded.frozen import Array
from grounded.result import listed
from grounded_trials.report.bodies import Scene, body_in, is_mechanism, scene_of
from grounded_trials.report.findings import Findings, Log, Run, compared
from grounded_trials.wording import labelled

OTHERS = 60  # largest number of runs behind the compared ones, and of tabs of a recording
LOG_ROLES = ("best", "model", "accepted", "limit")  # of the latest logs, if there is no run


class View(NamedTuple):
    """Two axes, and a function that maps states (T, n) to points (T, 2)."""

    title: str
    names: tuple[str, str]
    place: Callable[[Array], Array]
    equal: bool = False  # one scale on both axes


class Drawn(NamedTuple):
    """A path: states (T, n) at intervals dt, its look, and its trial."""

    states: Array
    dt: float
    role: str
    name: str
    trial: str = ""
    style: str = "line"


def _views(findings: Findings, scene: Scene) -> list[View]:
    """Return the views from above and from the side; without a position, of body or phase plane."""
    body = body_in(findings)
    if not scene.spatial and is_mechanism(body):
        names = labelled("x", body.unit), labelled("z, up", body.unit)
        side = View("From the side", names, lambda states: body.path(states)[:, [0, 2]], True)
        return [side] if findings.task.model.n > 2 else [side, _plane(scene, 1)]
    return [_plane(scene, axis) for axis in range(1, len(scene.axes))]


def _plane(scene: Scene, axis: int) -> View:
    """Return the view of an axis over the first one."""
    x, y = (labelled(scene.names[i], scene.units[i]) for i in (0, axis))
    columns = [scene.axes[0], scene.axes[axis]]
    equal = scene.spatial and scene.units[0] == scene.units[axis] and axis == 1
    return View(f"{y} over {x}", (x, y), lambda states: states[:, columns], equal)


def path_figure(findings: Findings) -> Figure | None:
    """Return the figure of the paths."""
    scene = scene_of(findings.task.model)
    views, drawn = _views(findings, scene), _drawn(findings)
    if sum(one.style == "line" for one in drawn) < (2 if findings.runs or not findings.logs else 1):
        return None
    panels, caption = [], []
    for view in views:
        curves = [_path(view, one) for one in drawn]
        curves += [mark for run in findings.runs for mark in _crash_mark(run, view)]
        panels.append(panel(view.title, *view.names, curves, equal=view.equal, kind="path"))
    if not scene.spatial and not views[0].equal:
        caption.append(f"Phase plane of {listed(scene.names)}.")
    if any(crash(run) for run in findings.runs):
        caption.append("A cross marks where a run ended early.")
    return Figure("paths", "Paths", " ".join(caption), panels)


def _drawn(findings: Findings) -> list[Drawn]:
    """Return every run's path, the compared ones on top, and the predictions as ghosts.

    Without runs, those of logs.
    """
    logs = [
        Drawn(log.trial.states, log.trial.dt, role, log.trial.id, log.trial.id)
        for log, role in zip(findings.logs[-len(LOG_ROLES) :], LOG_ROLES, strict=False)
    ]
    if not findings.runs and logs:
        return logs
    dt, best = findings.task.dt, compared(findings)
    ids = {run.trial.id for _, run in best}
    others = [r for r in findings.runs if r.trial.id not in ids][-OTHERS:]
    runs = [("other", r.label, r) for r in others] + [(o, name_of(o, r), r) for o, r in best]
    drawn = [Drawn(r.trial.states, dt, role, name, r.trial.id) for role, name, r in runs]
    for _, _, r in runs:
        states, name = r.candidate.predicted_states, f"predicted for {r.candidate.id}"
        drawn.append(Drawn(states, dt, "predicted", name, r.trial.id, "ghost"))
    named = named_paths(findings)
    drawn += [Drawn(s, dt, r, name) for r, name, s in named if r in ("predicted", "desired")]
    return drawn


def _path(view: View, one: Drawn) -> Trace:
    """Return a path with the times of its points."""
    width = 0.8 if one.role == "other" else WIDTHS.get(one.role, 1.5)
    times: Array = np.arange(len(one.states), dtype=np.float64) * one.dt
    x, y = view.place(one.states).T
    return curve(
        x, y, one.role, one.name, width, times=times, trial=one.trial, style=one.style
    )  # fmt: skip


def name_of(role: str, run: Run) -> str:
    """Return the name of a compared run in a legend."""
    return f"{'model’s policy' if role == 'model' else 'best so far'}, {run.label}"


def named_paths(findings: Findings) -> list[tuple[str, str, Array]]:
    """Return (role, name, states) of the compared paths, in drawing order."""
    found = [(role, name_of(role, run), run.trial.states) for role, run in compared(findings)]
    waiting = findings.standing.outstanding
    if not found and waiting is not None:
        found = [("predicted", f"predicted for {waiting.id}", waiting.predicted_states)]
    return [*found, ("desired", "desired", findings.task.target)]


def crash(run: Run | Log) -> int | None:
    """Return the step after which a run has no data, None if it is complete."""
    last = run.trial.finite_steps
    short = isinstance(run, Run) and (not np.isfinite(run.utility) or last < run.trial.steps)
    return last if short else None


def ended(run: Run) -> str:
    """Return when a run that ended early did: `t0007 (c0006) ended after 1.24 s of 3.00 s`."""
    planned = len(run.candidate.predicted_states) - 1  # the trial itself may be shorter
    last, whole = run.trial.finite_steps * run.trial.dt, planned * run.trial.dt
    return f"{run.label} ended after {last:.2f} s of {whole:.2f} s"


def _crash_mark(run: Run, view: View) -> list[Trace]:
    last = crash(run)
    if last is None:
        return []
    x, y = (float(v) for v in view.place(run.trial.states[[last]])[0])
    one = marks([x], [y], "model", [ended(run)], shape="cross", trial=run.trial.id)
    return [one] if np.isfinite(x + y) else []
