"""Check what a trial that is stored lacks or exceeds: gaps, an early end, [limits], [safety].

Whether its columns contain what their names say is asked by `log_faults.py`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from grounded.findings import Finding, Quantity, found
from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import HUGE, Trial, interpolate_gaps
from grounded_trials.workspace.folder import Folder

ROUNDED = 1e-6  # of an input's unit: a smaller excess over its limits is rounding


def checked(workspace: Folder, trial: Trial, last_s: float = math.nan) -> Iterator[Finding]:
    """Yield what is to be known of a trial.

    Args:
        workspace: the workspace with the task and the candidates.
        trial: the trial as stored.
        last_s: when the last of its states was logged, in seconds of the run; NaN if all are on the
            control grid.
    """
    task, filled = workspace.task, interpolate_gaps(trial)
    whole = filled.trial
    if filled.samples:
        longest, at = Quantity(filled.longest_s, "s"), Quantity(filled.at_s, "s")
        yield found("log.gaps", filled.state, samples=filled.samples, longest=longest, at=at)
    if whole.finite_steps < whole.steps:
        name, step = _first_bad(whole)
        ends = Quantity(step * trial.dt, "s") if step else "its start"
        yield found("file.vanished", name, ends=ends)
    if not trial.candidate:
        yield from _still(whole)
        yield from _beyond(workspace, whole)
        return
    if whole.steps < task.horizon and whole.whole(task.horizon) is not whole:
        missing = max(0.0, np.nan_to_num(1e3 * (task.horizon * task.dt - last_s)))
        yield found("log.short", steps=whole.steps, horizon=task.horizon, missing=missing)
    whole = whole.until(task.horizon)
    excess = np.maximum(task.low - whole.inputs, whole.inputs - task.high)
    for i, most in enumerate(excess.max(axis=0, initial=0.0)):
        if most > ROUNDED:
            name = whole.input_names[i]
            yield found("log.limits", name, most=Quantity(most, task.model.inputs[name]))
    candidate, _ = workspace.candidate(trial.candidate)
    if np.ptp(candidate.predicted_states, axis=0).any():
        yield from _still(whole)
    yield from _unsafe(task, whole, candidate)


def _first_bad(trial: Trial) -> tuple[str, int]:
    """Return the first state or input that is not a finite number, and its step."""
    places = [
        (int(step), name)
        for values, names in ((trial.states, trial.state_names), (trial.inputs, trial.input_names))
        for column, name in zip(values.T, names, strict=True)
        for step in np.flatnonzero(~(np.abs(column) < HUGE))[:1]
    ]
    step, name = min(places, key=lambda place: place[0])
    return name, step


def _unsafe(task: Task, trial: Trial, ran: Candidate) -> Iterator[Finding]:
    """Yield the states that left [safety], with the predicted value."""
    assert task.safety_low is not None and task.safety_high is not None
    states = trial.states[: trial.finite_steps + 1]
    for i, (name, unit) in enumerate(task.model.states.items() if len(states) else ()):
        values = states[:, i]
        excess = np.maximum(task.safety_low[i] - values, values - task.safety_high[i])
        t = int(np.argmax(excess))
        if excess[t] > 0:
            yield found(
                "run.safety",
                name,
                bound=Quantity(
                    float(np.clip(values[t], task.safety_low[i], task.safety_high[i])), unit
                ),
                at=Quantity(float(np.argmax(excess > 0)) * trial.dt, "s"),
                most=Quantity(float(values[t]), unit),
                predicted=Quantity(float(ran.predicted_states[t, i]), unit),
            )


def _still(trial: Trial) -> Iterator[Finding]:
    """Yield that no known state changes during a trial."""
    known = trial.states[:, np.isfinite(trial.states).any(axis=0)]
    if len(known) > 1 and not np.any(np.nanmax(known, axis=0) > np.nanmin(known, axis=0)):
        yield found("log.still", trial=trial.id)


def _beyond(workspace: Folder, trial: Trial) -> Iterator[Finding]:
    """Yield logged inputs that exceed [limits], which were taken from another log."""
    from grounded.accounts.signals import beyond_limits, in_percent, limits_of, span

    task, mapping = workspace.task, workspace.log_mapping
    past = np.any(beyond_limits(task, trial.inputs), axis=0)
    inside = ~np.any(beyond_limits(task, -trial.inputs), axis=0)
    for i, name in enumerate(trial.input_names):
        if past[i]:
            turned = inside[i] and mapping is not None and mapping.inputs[name].scale < 0
            how = "percent" if in_percent(task, trial.inputs, i) else "flip" if turned else "widen"
            logged, limits = span(trial.inputs[:, i]), limits_of(task, i)
            yield found("log.limits", name, logged=logged, limits=limits, how=how)
