"""Figures over time: states, tracking error, inputs, bias; and the list of all figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np

from grounded.diagnosis.telling import accuracy_figure
from grounded.figures import (
    STEPS,
    Figure,
    Panel,
    Trace,
    calm_range,
    curve,
    marks,
    panel,
    rule,
)
from grounded.frozen import Array
from grounded.result import listed
from grounded.search.pictures import search_figure
from grounded_trials.report.bodies import reading_order, scene_of
from grounded_trials.report.figures.paths import crash, name_of, named_paths, path_figure
from grounded_trials.report.findings import (
    ESTIMATED,
    Findings,
    Run,
    compared,
    prediction_error,
)
from grounded_trials.report.forecast import forecast_figures
from grounded_trials.wording import figure, labelled, per_second, shown
from grounded_trials.workspace.off_target import asked_for, tracked, tracking_error

DESIRED_END = "desired at the end"  # of a state that only `terminal` weighs
ITERATIONS = 5  # largest number of iterations whose bias is drawn
MOST_MEANS = 100  # means of a noisy curve


@lru_cache(maxsize=1)
def all_figures(findings: Findings) -> tuple[Figure, ...]:
    """Return all figures of a report in reading order, without empty ones."""
    runs = (path_figure, state_figure, input_figure, error_figure, bias_figure)
    made = [search_figure(findings.standing), *(draw(findings) for draw in runs)]
    if findings.diagnosis is not None:
        made.append(accuracy_figure(findings.diagnosis))
    made += forecast_figures(findings)
    return tuple(figure for figure in made if figure is not None)


def _compared(
    findings: Findings, values: Callable[[Run], Array], column: int, style: str = "line"
) -> tuple[list[Trace], list[Trace]]:
    """Return a column of each compared run's values, with crosses where the run ended early."""
    curves, crosses, dt = list[Trace](), list[Trace](), findings.task.dt
    for role, run in compared(findings):
        each, name = values(run)[:, column], name_of(role, run)
        curves.append(_over_time(each, dt, role, name, style=style))
        if (last := crash(run)) is not None:
            said = [f"{name} ended early"]
            crosses.append(marks([last * dt], [each[last]], role, said, shape="cross"))
    return curves, crosses


def state_figure(findings: Findings) -> Figure | None:
    """Return the figure of each state over time, with its prediction.

    Its target is drawn along the way or at the end, where [reward] weighs it.
    """
    task, paths = findings.task, named_paths(findings)
    if len(paths) < 2:
        return None
    wanted, panels = asked_for(task), []
    for i in reading_order(task):
        name, unit = list(task.model.states.items())[i]
        along = i in wanted and task.reward.state[i] > 0
        curves = [
            _over_time(states[:, i], task.dt, role, words)
            for role, words, states in paths
            if role != "desired" or along
        ]
        curves += _compared(findings, lambda run: run.trial.states, i)[1]
        if i in wanted and not along:
            at, value = task.horizon * task.dt, float(task.target[-1, i])
            asked = marks([at], [value], "desired", [DESIRED_END], shape="ring", name=DESIRED_END)
            curves.append(asked)
        note = ESTIMATED * (name in findings.estimated)
        panels.append(_timed(name, unit, curves, note=note))
    return Figure("states", "States over time", "", panels)


def error_figure(findings: Findings) -> Figure | None:
    """Return the figure of the errors from the target, and from the run's own prediction."""
    task, shown, panels = findings.task, compared(findings), []
    if not shown:
        return None
    scene = scene_of(task.model)
    axes = list(scene.axes)
    if scene.spatial and {*axes} <= {*tracked(task)}:

        def distance(run: Run) -> Array:
            off = tracking_error(task, run.trial)[:, axes]
            return np.asarray(np.linalg.norm(off, axis=1, keepdims=True))

        curves, crosses = _compared(findings, distance, 0)
        name, unit = "distance from the desired position", list(task.model.states.values())[axes[0]]
        panels.append(_timed(name, unit, [*curves, *crosses], most=50.0))
    for i in (i for i in reading_order(task) if i in asked_for(task)):
        name, unit = list(task.model.states.items())[i]
        curves, crosses = _compared(findings, lambda run: tracking_error(task, run.trial), i)
        _, run = shown[-1]
        gap, words = prediction_error(task, run)[:, i], f"real − predicted, {run.label}"
        curves.append(_over_time(gap, task.dt, "predicted", words, 1.0))
        panels.append(_timed(f"{name} − target", unit, [*curves, *crosses], most=50.0))
    return Figure("error", "Tracking error", "", panels)


def input_figure(findings: Findings) -> Figure | None:
    """Return the figure of each input over time, with its limits: commands with zero-order hold."""
    task, panels = findings.task, []
    if not compared(findings):
        return None
    for j, (name, unit) in enumerate(task.model.inputs.items()):
        curves, _ = _compared(
            findings, lambda run: np.vstack([run.trial.inputs, run.trial.inputs[-1:]]), j, "steps"
        )
        limits = [float(v) for v in (task.low[j], task.high[j]) if np.isfinite(v)]
        panels.append(_timed(name, unit, curves, limits))
    return Figure("inputs", "Inputs", "", panels)


def bias_figure(findings: Findings) -> Figure | None:
    """Return the figure of the crude model's bias along the run, by iteration."""
    task, best = findings.task, findings.best
    runs = findings.improvements(ITERATIONS)
    if not runs:
        return None
    roles = ["model", *(STEPS[k % 3] for k in range(len(runs) - 2)), "best"][: len(runs)]
    drawn = [
        (run.residual, role, f"{run.candidate.id}, iteration {run.candidate.iteration}", 1.0)
        for role, run in zip(roles, runs, strict=True)
    ]
    if best is not None and best.explained is not None and findings.better is not None:
        drawn.append((best.explained, "predicted", f"model {findings.better.name}", 1.5))
    panels, window = [], window_of(max(len(values) for values, *_ in drawn))
    middle = 0.5 * (window - 1) * task.dt  # of the steps of a mean
    note = f"means: {window * task.dt:.2g} s" * (window > 1)
    for i in reading_order(task):
        name, unit = list(task.model.states.items())[i]
        curves = []
        for values, role, words, width in drawn:
            mean = averaged(values[:, i] / task.dt, window)
            curves.append(_over_time(mean, window * task.dt, role, words, width, middle))
        panels.append(_timed(name, per_second(unit), curves, note=note))
    return Figure("bias", "Bias", "", panels)


def _over_time(
    values: Array,
    dt: float,
    role: str,
    name: str,
    width: float = 1.5,
    start: float = 0.0,
    style: str = "line",
) -> Trace:
    times: Array = start + np.arange(len(values), dtype=np.float64) * dt
    return curve(times, values, role, name, width, style=style)


def _timed(
    name: str,
    unit: str,
    curves: Sequence[Trace],
    limits: Sequence[float] = (),
    most: float = 5.0,
    note: str = "",
) -> Panel:
    """Return a panel over time, scaled by `calm_range` around all but the model's own policy.

    If that run is cut off, or a limit is, the note states what lies outside.
    """
    calm = [c["y"] for c in curves if c["meta"]["role"] != "model"]
    wild = [c["y"] for c in curves if c["meta"]["role"] == "model"]
    within = np.array(calm_range(calm, wild, most))
    low, high = calm_range([within], [np.array(limits)]) if limits else within.tolist()
    beyond = _outside(wild, low, high, "up to"), _outside([np.array(limits)], low, high, "limits")
    return panel(
        labelled(name, unit),
        "time [s]",
        shown(unit),
        curves,
        [rule(v, "limit", "limit") for v in limits],
        y_range=(low, high),
        note="; ".join(filter(None, (*beyond, note))),
        kind="time",
    )


def _outside(values: list[Array], low: float, high: float, words: str) -> str:
    """Return a note with the extreme values outside the picture, "" if all are inside."""
    finite = [v[np.isfinite(v)] for v in values]
    ends = {float(e) for v in finite if len(v) for e in (v.min(), v.max())}
    out = [figure(e, 2).replace("-", "−") for e in sorted(ends) if not low <= e <= high]
    return f"{words} {listed(out)}" if out else ""


def window_of(steps: int) -> int:
    """Return over how many steps residuals are averaged, so that about `MOST_MEANS` are drawn.

    A residual divided by dt multiplies a sensor's noise by 1/dt: at 50 Hz, 5 mm is 0.35 m/s.
    """
    return max(1, steps // MOST_MEANS)


def averaged(values: Array, window: int) -> Array:
    """Return means (T // window, ...) over consecutive steps."""
    whole = values[: len(values) // window * window]
    return np.asarray(whole.reshape(-1, window, *values.shape[1:]).mean(axis=1))
