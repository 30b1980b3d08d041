"""Figures of paths: the runs in the plane, the error as a colour, deviations enlarged.

A mechanism without a position in the plane is drawn from the side, with the path of its tip.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from grounded.figures.body import Body, motion
from grounded.figures.figure import WIDTHS, Curve, Dot, Figure, Panel, enlarging, legend
from grounded.frozen import Array
from grounded.result import listed
from grounded_trials.report.bodies import Scene, body_in, is_mechanism, scene_of
from grounded_trials.report.findings import Findings, Log, Run, compared
from grounded_trials.wording import labelled

OTHERS = 60  # largest number of runs drawn behind the compared ones
LOGS = 4  # largest number of logs drawn if there is no run
LOG_ROLES = ("best", "model", "accepted", "limit")
SEEN = 5.0  # smallest factor at which enlarged deviations are drawn
MOSTLY = 0.5  # a path with a larger share beyond ENLARGED_TO is left out
FLAT = 0.1  # smallest height of a view from the side, as a fraction of its width
ENLARGED_TO = 0.4  # limit of enlarged deviations, as a fraction of the desired path's size


@dataclass(frozen=True, eq=False)
class View:
    """Two axes, and a function that maps states (T, n) to points (T, 2)."""

    names: tuple[str, str]
    place: Callable[[Array], Array]
    equal: bool
    body: Body | None = None
    side: bool = False  # a height over a distance, in one unit, each with its own scale

    @property
    def title(self) -> str:
        """The title of its panel."""
        return "{1} over {0}".format(*self.names) if self.body is None else "From the side"


def _views(findings: Findings, scene: Scene) -> list[View]:
    """Return the views from above and from the side; without a position, of body or phase plane."""
    body = body_in(findings)
    if not scene.spatial and is_mechanism(body):
        names = labelled("x", body.unit), labelled("z, up", body.unit)
        side = View(names, lambda states: body.path(states)[:, [0, 2]], True, body)
        return [side] if findings.task.model.n > 2 else [side, _plane(scene, 1)]
    return [_plane(scene, axis) for axis in range(1, len(scene.axes))]


def _plane(scene: Scene, axis: int) -> View:
    """Return the view of an axis over the first one."""
    x, y = (labelled(scene.names[i], scene.units[i]) for i in (0, axis))
    one = scene.spatial and scene.units[0] == scene.units[axis]

    def place(states: Array) -> Array:
        return states[:, [scene.axes[0], scene.axes[axis]]]

    return View((x, y), place, one and axis == 1, side=one and axis > 1)


def path_figure(findings: Findings) -> Figure | None:
    """Return the figure of the paths, the enlarged deviations and the error along the best path."""
    scene = scene_of(findings.task.model)
    views = _views(findings, scene)
    logs = not findings.runs and bool(findings.logs) and not scene.volume
    if not views or (len(named_paths(findings)) < 2 and not logs):
        return None
    body, caption = views[0].body, []
    if logs:
        panels = [_of_logs(findings, view) for view in views]
    else:
        panels = [_seen_in(findings, view) for view in views]
        if views[0].equal and findings.runs:
            panels += _enlarged(findings, views[0]) + _shaded(findings, views[0])
    if body is None and not scene.spatial:
        caption.append(f"Phase plane of {listed(scene.names)}.")
    if body is not None and not body.unit:
        caption.append("Name lengths of links l, or l1, l2 ... [m].")
    if any(crash(run) for run in findings.runs):
        caption.append("A cross marks where a run ended early.")
    return Figure("paths", "Paths", " ".join(caption), tuple(panels), legend(panels[:1]))


def _of_logs(findings: Findings, view: View) -> Panel:
    """Draw the paths in the logs, for a workspace without runs."""
    curves = []
    for k, log in enumerate(findings.logs[-LOGS:]):
        states, dt, name = log.trial.states, log.trial.dt, log.trial.id
        curves.append(_path(view, states, dt, LOG_ROLES[k], name, name, "line"))
    return Panel(view.title, *view.names, tuple(curves), equal=view.equal, kind="path")


def _path(
    view: View, states: Array, dt: float, role: str, name: str, trial: str, style: str
) -> Curve:
    """Return a path with the times of its points, and the body that moves along it."""
    width = 0.8 if role == "other" else WIDTHS.get(role, 1.5)
    moved = None if view.body is None else motion(view.body, states, dt)
    times: Array = np.arange(len(states), dtype=np.float64) * dt
    x, y = view.place(states).T
    return Curve(x, y, role, name, width, times, trial=trial, style=style, motion=moved)


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


def _seen_in(findings: Findings, view: View) -> Panel:
    """Draw every run's path, the compared ones on top, and the predictions as ghosts."""
    dt = findings.task.dt
    shown = compared(findings)  # means of several runs have no id
    ids = {run.trial.id for _, run in shown}
    others = [r for r in findings.runs if r.trial.id not in ids][-OTHERS:]
    runs = [("other", r.label, r) for r in others]
    runs += [(role, name_of(role, r), r) for role, r in shown]
    drawn = [(r.trial.states, role, name, r.trial.id, "line") for role, name, r in runs]
    for _, _, r in runs:
        name = f"predicted for {r.candidate.id}"
        drawn.append((r.candidate.predicted_states, "predicted", name, r.trial.id, "ghost"))
    drawn += [
        (states, role, name, "", "line")
        for role, name, states in named_paths(findings)
        if role in ("predicted", "desired")
    ]
    curves = tuple(_path(view, states, dt, *words) for states, *words in drawn)
    dots = tuple(d for _, _, r in runs for d in _crash_mark(r, view))
    y_range = _level(curves) if view.side else None
    return Panel(
        view.title, *view.names, curves, dots, equal=view.equal, y_range=y_range, kind="path"
    )


def _level(curves: Sequence[Curve]) -> tuple[float, float] | None:
    """Return a range in which a level flight looks level; None if the heights differ by more."""
    x, y = (np.concatenate([getattr(c, axis) for c in curves]) for axis in ("x", "y"))
    x, y = x[np.isfinite(x)], y[np.isfinite(y)]
    if not len(y) or not np.ptp(y) < FLAT * np.ptp(x):
        return None
    middle, half = 0.5 * float(y.min() + y.max()), 0.5 * FLAT * float(np.ptp(x))
    return middle - half, middle + half


def _crash_mark(run: Run, view: View) -> list[Dot]:
    last = crash(run)
    if last is None:
        return []
    x, y = (float(v) for v in view.place(run.trial.states[[last]])[0])
    if not np.isfinite(x + y):
        return []
    return [Dot(x, y, "model", ended(run), "cross", trial=run.trial.id)]


def _enlarged(findings: Findings, view: View) -> list[Panel]:
    """Draw the compared paths with enlarged deviations, if these are too small to see."""
    desired = view.place(findings.task.target)
    if not np.isfinite(desired).all():
        return []
    factor = enlarging(view.place(compared(findings)[-1][1].trial.states), desired)
    if factor < SEEN:
        return []
    curves, note = [], ""
    for role, name, states in named_paths(findings):
        near = desired[: len(states)]
        path = near + factor * (view.place(states) - near)
        off = np.abs(path - near).max(axis=1) > ENLARGED_TO * np.ptp(desired, axis=0).max()
        path[off] = np.nan
        if off.mean() > MOSTLY:
            note = f"{role} outside"
        else:
            width = WIDTHS.get(role, 1.5)
            curves.append(Curve(path[:, 0], path[:, 1], role, name, width))
    title = f"Deviations {factor:g} times enlarged"
    return [Panel(title, *view.names, tuple(curves), equal=True, note=note, kind="path")]


def _shaded(findings: Findings, view: View) -> list[Panel]:
    """Draw the best path, coloured by its distance from the desired position."""
    (_, run), body = compared(findings)[-1], body_in(findings)
    states, target = run.trial.states, findings.task.target
    desired = body.path(target)
    if not np.isfinite(desired).all() or not body.unit:  # no distance without a length
        return []
    far = np.linalg.norm(body.path(states) - desired[: len(states)], axis=1)
    times: Array = np.arange(len(states), dtype=np.float64) * findings.task.dt
    name = labelled("off", body.unit)
    (x, y), (a, b) = view.place(states).T, view.place(target).T
    path = Curve(x, y, "other", "", 1.0, times, far, name)
    wanted = Curve(a, b, "desired", "desired", 1.0)
    title = f"Error of {body.watched}, {run.label}"
    return [Panel(title, *view.names, (path, wanted), equal=True, kind="path")]
