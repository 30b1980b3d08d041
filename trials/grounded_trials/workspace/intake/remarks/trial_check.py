"""Warnings about a trial that the user should know before relying on it.

`grounded.search.returned.who_drove` checks whether it ran its candidate at all, `log_faults.py`
whether its columns contain what their names say.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grounded.result import listed
from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import HUGE, Trial, interpolate_gaps
from grounded_trials.wording import with_unit
from grounded_trials.workspace.folder import Folder

FLIP = "its scale in [log] is negative, so multiply these limits by -1 too, if they are of the log"
WIDEN = "no plan will use that; widen them if the robot can take it"


def warnings_about(
    workspace: Folder,
    trial: Trial,
    last_s: float = float("nan"),
    fell: bool = False,
    scaled: Sequence[str] = (),
) -> tuple[str, ...]:
    """Return warnings on gaps, an early end, a start far from s_0, and exceeded bounds.

    Args:
        workspace: the workspace with the task and the candidates.
        trial: the trial as stored.
        last_s: when the last of its states was logged, in seconds of the run; NaN if all are on the
            control grid.
        fell: whether it was already reported that the run failed where the trial ends.
        scaled: inputs for which another unit was already reported.
    """
    task = workspace.task
    filled = interpolate_gaps(trial)
    found = []
    if filled.samples:
        found.append(
            f"{filled.samples} lost samples were interpolated, the longest gap is "
            f"{filled.longest_s:.2f} s of '{filled.state}' at {filled.at_s:.2f} s"
        )
    whole = filled.trial
    if whole.finite_steps < whole.steps:
        name, step = _first_bad(whole)
        found.append(
            f"'{name}' is not a finite number at {step * trial.dt:.2f} s: the trial is treated "
            "as ended there"
        )
    if not trial.candidate:
        stood = _halted(workspace, whole)
        return (*found, *_still(whole), *stood, *_beyond(workspace, whole, scaled))
    if whole.steps < task.horizon and whole.whole(task.horizon) is not whole:
        ends = f"after {whole.steps} of {task.horizon} steps ({whole.steps * trial.dt:.2f} s)"
        found.append(
            f"the log ends {ends}{_lacking(task, last_s)}: the rest is extrapolated from the last "
            "steps. Log at least one more row after the last command"
        )
    if whole.steps > task.horizon:
        found.append(
            f"the log continues for {whole.steps - task.horizon} steps after the horizon of "
            f"{task.horizon}: they are not judged"
        )
    whole = whole.until(task.horizon)
    found += _inputs(task, whole)
    candidate, _ = workspace.candidate(trial.candidate)
    found += _still(whole) if np.ptp(candidate.predicted_states, axis=0).any() else []
    found += [] if fell else _unsafe(task, whole, candidate)
    return tuple(found)


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


def _lacking(task: Task, last_s: float) -> str:
    """Return by how much a log misses the plan's last state, as a clause of a sentence; or ""."""
    missing = task.horizon * task.dt - last_s
    if not missing > 0:  # only its commands end early, or its rows are the control steps
        return ""
    return f", with its last state {1e3 * missing:.3g} ms before the plan's last"


def _unsafe(task: Task, trial: Trial, ran: Candidate) -> list[str]:
    """Return warnings for states that left [safety], with the predicted value."""
    assert task.safety_low is not None and task.safety_high is not None
    states = trial.states[: trial.finite_steps + 1]
    found = []
    for i, (name, unit) in enumerate(task.model.states.items() if len(states) else ()):
        low, high, values = task.safety_low[i], task.safety_high[i], states[:, i]
        excess = np.maximum(low - values, values - high)
        t = int(np.argmax(excess))
        if excess[t] > 0:
            first = float(np.argmax(excess > 0)) * trial.dt
            predicted = with_unit(f"{ran.predicted_states[t, i]:.3g}", unit)
            found.append(
                f"the run left [safety] {name} = [{low:g}, {high:g}] at {first:.2f} s: {name} was "
                f"{with_unit(f'{values[t]:.3g}', unit)} at {t * trial.dt:.2f} s, where "
                f"{predicted} was predicted"
            )
    return found


def _inputs(task: Task, trial: Trial) -> list[str]:
    if not trial.steps:
        return []
    excess = np.maximum(task.low - trial.inputs, trial.inputs - task.high).max(axis=0)
    return [
        f"{name} in the log is up to {excess[i]:.3g} outside its [limits]: log the COMMANDS, after "
        "clipping"
        for i, name in enumerate(trial.input_names)
        if excess[i] > 1e-6
    ]


def _still(trial: Trial) -> list[str]:
    """Return a warning if no known state changes during a trial."""
    known = trial.states[:, np.isfinite(trial.states).any(axis=0)]
    if len(known) < 2 or np.any(np.nanmax(known, axis=0) > np.nanmin(known, axis=0)):
        return []
    return [
        "no state changes in it: was the robot switched on, and are these the columns of its "
        f"sensors? fit and diagnose learn nothing from it; `discard {trial.id}` sets it aside"
    ]


def _halted(workspace: Folder, trial: Trial) -> list[str]:
    """Return a warning if the robot stood still in data under commands that had moved it before."""
    from grounded.accounts.halted import halted

    if (stood := halted(workspace.base_model, trial)) is None:
        return []
    to_its_end = stood.ends > trial.known_steps * trial.dt - 1.0
    when = f"{stood.begins:.1f} s on" if to_its_end else f"{stood.begins:.1f} to {stood.ends:.1f} s"
    sent = f"{listed(stood.inputs)} change{'s' * (len(stood.inputs) == 1)}"
    return [
        f"nothing moves from {when}, though {sent}, and the robot had set off with less: was it "
        "against a wall or a stop, or switched off? A diagnosis takes that for its physics: "
        f"cut the log there ([log.span] end), `discard {trial.id}` and ingest it again"
    ]


def _beyond(workspace: Folder, trial: Trial, scaled: Sequence[str]) -> list[str]:
    """Return warnings if logged inputs exceed [limits] that were taken from another log."""
    from grounded.accounts.inputs import beyond_limits, in_percent, limits_of, span

    task, mapping = workspace.task, workspace.log_mapping
    past = np.any(beyond_limits(task, trial.inputs), axis=0)
    turned = [n for n, one in mapping.inputs.items() if one.scale < 0] if mapping else []
    inside = ~np.any(beyond_limits(task, -trial.inputs), axis=0)
    return [
        f"{name} goes from {span(trial.inputs[:, i])} in this log, beyond its [limits], "
        f"{limits_of(task, i)}: "
        + (in_percent(task, trial.inputs, i) or (FLIP if inside[i] and name in turned else WIDEN))
        for i, name in enumerate(trial.input_names)
        if past[i] and name not in scaled
    ]
