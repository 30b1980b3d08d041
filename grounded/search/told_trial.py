"""Check a trial that was told in Python: whether it ran its candidate, and its columns.

The same checks as `grounded ingest` makes, worded for a program: there is no log to ingest again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from grounded.accounts.finding import UnusableTrials, in_the_log
from grounded.accounts.reported import scaled
from grounded.accounts.returned import Kind, suspicion, unit_by_factor
from grounded.accounts.sound_trials import sound_trials
from grounded.findings import Finding, found
from grounded.model import Model
from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import Trial, interpolate_gaps


def odd_trial(
    task: Task, candidates: Sequence[Candidate], trial: Trial, *, first: bool
) -> Finding | None:
    """Return why a trial can't be a run of its candidate as it is, if it can't.

    Args:
        task: the task of the candidates.
        candidates: those proposed so far, one of which the trial names.
        trial: the trial as it was told.
        first: whether its columns are also checked against each other and the model.
    """
    whole, model = interpolate_gaps(trial).trial, task.model
    own = next(one for one in candidates if one.id == trial.candidate)
    if whole.finite_steps < 1 and (unknown := _unknown(trial)):
        return found("given.value", *unknown, must="finite")
    seen = suspicion(task, whole, own, candidates)
    units = [(one.names, one.by) for one in seen.stories if one.kind is Kind.UNIT]
    names, by = units[0] if units else ((), 1.0)
    if unit := unit_by_factor(model, names, by):  # the columns may agree with each other
        return scaled(model, names, 1 / by, unit).also(ran=own.id)
    columns = _odd_columns(model, whole) if first else None
    if columns or not (names or seen.why):
        return columns
    return scaled(model, names, 1 / by).also(ran=own.id) if names else seen.why


def crashed(task: Task, trial: Trial) -> Finding | None:
    """Return that a trial counts as a crash, if it does."""
    if np.isfinite(task.utility(whole := interpolate_gaps(trial).trial)):
        return None
    until, large = min(whole.finite_steps, whole.steps), whole.finite_steps >= task.horizon
    facts: dict[str, Any] = {"steps": max(until, 0), "horizon": task.horizon, "large": large}
    return found("run.failed", trial.candidate, **facts)


def _unknown(trial: Trial) -> list[str]:
    """Return the signals without a value at the start."""
    known = [*np.isfinite(trial.states[0])]
    known += [*np.isfinite(trial.inputs[0])] if trial.steps else []
    names = (*trial.state_names, *trial.input_names)
    return [name for name, is_known in zip(names, known, strict=False) if not is_known]


def _odd_columns(model: Model, trial: Trial) -> Finding | None:
    """Return what is wrong with the columns of a trial, in units, signs or names."""
    try:
        looked = sound_trials(model, [replace(trial, id="")])
    except UnusableTrials as error:
        return error.findings[0]
    for one in in_the_log(looked.findings):
        return scaled(model, [one.signal], one.scale, "" if one.kind == "sign" else "deg")
    return None
