"""The figures of the runs: paths, states, tracking error, inputs, bias."""

from __future__ import annotations

import numpy as np

from grounded.frozen import Array
from grounded_trials.report.figures.axis import fitted, without_astray
from grounded_trials.report.figures.figure import Curve, Figure, Panel, Rule, legend
from grounded_trials.report.findings import (
    Findings,
    Run,
    prediction_error,
    selection,
    tracked,
    tracking_error,
)
from grounded_trials.report.scene import scene_of
from grounded_trials.wording import figure, labelled, per_second, shown

TIME = "time [s]"
ITERATIONS = 5
OTHERS = 60  # runs that are drawn faintly behind the paths
STEPS = ("step1", "step2", "step3")


def path_figure(findings: Findings) -> Figure | None:
    """The paths in the plane, and seen from the side where there is an altitude."""
    scene = scene_of(findings.task.model)
    if len(scene.axes) < 2 or len(_paths(findings)) < 2:
        return None
    panels = [_plane(findings, scene.axes[0], scene.axes[1], plan=True)]
    if scene.volume:
        panels.append(_plane(findings, scene.axes[0], scene.axes[2], plan=False))
    if scene.spatial and findings.runs and set(scene.axes) <= set(tracked(findings.task)):
        panels.append(_distance(findings, list(scene.axes)))
    caption = "Grey: all other trials." if len(findings.runs) > 2 else ""
    if not scene.spatial:
        caption = f"The model names no position: its first two states. {caption}"
    return Figure("paths", "Paths", caption.strip(), tuple(panels), legend(panels))


def _plane(findings: Findings, a: int, b: int, plan: bool) -> Panel:
    task = findings.task
    named = [(run.trial.id, run) for _, run in _shown(findings)]
    known = {identity for identity, _ in named}
    others = [r for r in findings.runs if r.trial.id not in known][-OTHERS:]
    times: Array = np.arange(task.horizon + 1, dtype=np.float64) * task.dt
    curves = [Curve(r.trial.states[:, a], r.trial.states[:, b], "other", "", 0.5) for r in others]
    for role, name, states in _paths(findings):
        width = {"best": 2.5, "desired": 1.0}.get(role, 1.5)
        curves.append(Curve(states[:, a], states[:, b], role, name, width, times[: len(states)]))
    names = list(task.model.states.items())
    axis = [labelled(name, unit) for name, unit in (names[a], names[b])]
    title, equal = f"{names[b][0]} over {names[a][0]}", plan and names[a][1] == names[b][1]
    return Panel(title, axis[0], axis[1], tuple(curves), equal=equal)


def _distance(findings: Findings, axes: list[int]) -> Panel:
    """How far the position was from where it should have been at that time."""
    task = findings.task
    unit = task.model.states[task.model.state_names[axes[0]]]
    curves = []
    for role, run in _shown(findings):
        off = np.linalg.norm(tracking_error(task, run.trial)[:, axes], axis=1)
        curves.append(_over_time(off, task.dt, role, _name(role, run)))
    return _timed(labelled("distance from the desired position", unit), unit, curves, spare=50.0)


def _shown(findings: Findings) -> list[tuple[str, Run]]:
    """The two runs that every figure compares, by role."""
    runs = [("model", findings.first), ("best", findings.best)]
    found = [(role, run) for role, run in runs if run is not None]
    if len(found) == 2 and found[0][1].candidate is found[1][1].candidate:
        return found[:1]
    return found


def _name(role: str, run: Run) -> str:
    return f"{'model’s policy' if role == 'model' else 'best so far'}, {run.label}"


def _paths(findings: Findings) -> list[tuple[str, str, Array]]:
    """(role, name, states) of what is compared, first what lies behind."""
    found = [(role, _name(role, run), run.trial.states) for role, run in _shown(findings)]
    waiting = findings.standing.outstanding
    if not found and waiting is not None:
        found = [("predicted", f"predicted for {waiting.id}", waiting.predicted_states)]
    return [*found, ("desired", "desired", findings.task.target)]


def state_figure(findings: Findings) -> Figure | None:
    """Each state over time, beside its target and prediction."""
    task = findings.task
    if len(_paths(findings)) < 2:
        return None
    known, panels = tracked(task), []
    for i, (name, unit) in enumerate(task.model.states.items()):
        curves = [
            _over_time(states[:, i], task.dt, role, words)
            for role, words, states in _paths(findings)
            if role != "desired" or i in known
        ]
        panels.append(_timed(labelled(name, unit), unit, curves))
    return Figure("states", "States over time", "", tuple(panels), legend(panels))


def error_figure(findings: Findings) -> Figure | None:
    """Distance to the target, and to what was predicted for the same run."""
    task = findings.task
    shown, panels = _shown(findings), []
    if not shown:
        return None
    for i in tracked(task):
        name, unit = task.model.state_names[i], list(task.model.states.values())[i]
        curves = [
            _over_time(tracking_error(task, run.trial)[:, i], task.dt, role, _name(role, run))
            for role, run in shown
        ]
        run = shown[-1][1]
        gap = prediction_error(task, run)[:, i]
        words = f"real − predicted, {run.label}"
        curves.append(_over_time(gap, task.dt, "predicted", words, 1.0))
        panels.append(_timed(labelled(f"{name} − target", unit), unit, curves, spare=50.0))
    caption = "How far each run was from its target, and from what the model had predicted for it."
    return Figure("error", "Tracking error", caption, tuple(panels), legend(panels))


def input_figure(findings: Findings) -> Figure | None:
    """Each input over time against its limits."""
    task = findings.task
    if not _shown(findings):
        return None
    panels = []
    for j, (name, unit) in enumerate(task.model.inputs.items()):
        curves = [
            _over_time(run.trial.inputs[:, j], task.dt, role, _name(role, run), 1.5)
            for role, run in _shown(findings)
        ]
        limits = [v for v in (task.low[j], task.high[j]) if np.isfinite(v)]
        rules = [Rule(float(v), "limit", "limit") for v in limits]
        panels.append(_timed(labelled(name, unit), unit, curves, rules))
    return Figure("inputs", "Inputs", "", tuple(panels), legend(panels))


def bias_figure(findings: Findings) -> Figure | None:
    """What the crude model lacks along the run, by iteration."""
    task = findings.task
    runs = selection(findings.improvements, ITERATIONS)
    if not runs:
        return None
    panels = []
    for i, (name, unit) in enumerate(task.model.states.items()):
        curves = []
        for k, run in enumerate(runs):
            role = "model" if k == 0 else "best" if k == len(runs) - 1 else STEPS[(k - 1) % 3]
            words = f"iteration {run.candidate.iteration}"
            curves.append(_over_time(run.residual[:, i] / task.dt, task.dt, role, words, 1.0))
        best = findings.best
        if best is not None and best.explained is not None and findings.better is not None:
            rest = best.explained[:, i] / task.dt
            words = f"left of the last, model {findings.better.name}"
            curves.append(_over_time(rest, task.dt, "predicted", words, 1.5))
        panels.append(_timed(labelled(name, per_second(unit)), per_second(unit), curves))
    caption = (
        f"What must be added to the rate of change of the {findings.plain} for it to replay the "
        "trial. A curve that keeps its shape over the iterations is a property of the system, not "
        "of a run."
    )
    return Figure("bias", "Bias of the model", caption, tuple(panels), legend(panels))


def _over_time(values: Array, dt: float, role: str, name: str, width: float = 1.5) -> Curve:
    times: Array = np.arange(len(values), dtype=np.float64) * dt
    return Curve(times, values, role, name, width)


def _timed(
    title: str,
    unit: str,
    curves: list[Curve],
    rules: list[Rule] | None = None,
    spare: float = 3.0,
) -> Panel:
    """A panel over time; a first run that went astray is cut off rather than flatten the others.

    A note says so then, and how far the run went.
    """
    rules = rules or []
    calm = [c.y for c in curves if c.role != "model"] + [np.array([r.y for r in rules])]
    wild = [c.y for c in curves if c.role == "model"]
    values = without_astray(calm, wild, spare) if any(len(v) for v in calm) else wild
    bounds = fitted(values)
    note, lines = _cut_off(wild, bounds), tuple(rules)
    return Panel(title, TIME, shown(unit), tuple(curves), rules=lines, y_range=bounds, note=note)


def _cut_off(values: list[Array], bounds: tuple[float, float]) -> str:
    """How far values go that lie outside the picture, "" where all are inside."""
    finite = [v[np.isfinite(v)] for v in values]
    ends = [float(e) for v in finite if len(v) for e in (v.min(), v.max())]
    out = sorted({e for e in ends if not bounds[0] <= e <= bounds[1]})
    if not out:
        return ""
    reached = " and ".join(figure(e, 2) for e in out).replace("-", "−")
    return f"model’s policy is cut off: it reaches {reached}"
