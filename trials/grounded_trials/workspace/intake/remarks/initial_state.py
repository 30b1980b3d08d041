"""Tell of a run that started away from [task] start, and whether that spoils its utility.

By how much a start changes the utility, the model says: it runs the candidate from there and from
s_0. A run whose utility it changes much says nothing about its candidate, and must be run again;
unless it is better than the best from either start.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded.accounts.sent import STEPS_TO_JUDGE
from grounded.findings import Finding, Quantity, found
from grounded.frozen import Array, median
from grounded.search.difference import Repeats, worth_of_start
from grounded.search.noise import sample_noise
from grounded.task import Task
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.workspace.candidates.search_state import standing_of
from grounded_trials.workspace.folder import Contents, Folder

START_IS_OFF = 3.0  # times sensor noise, and earlier starts' rms, by which a start must be off
TOLD, SPOILT = 0.05, 0.5  # share of the run's cost by which the start changes it: told; too much
FEWEST = 2  # runs from which it is told how exactly the robot is placed
MEDIAN_TO_STD = 1.4826  # of the size of a normal variable
LATEST = 50  # runs that are looked at; the way of placing a robot may change


def begun_elsewhere(workspace: Folder, trial: Trial) -> Finding | None:
    """Return in which states a run did not start at s_0, beyond sensor noise; None if in none.

    A change of the utility below the scatter of single runs is not told. Offsets as other starts
    have them (`placing`) spoil nothing: a repeat would begin no nearer, and the search allows for
    what they cost.

    Args:
        workspace: the workspace with the task, the model and the earlier runs.
        trial: the trial as stored.
    """
    task = workspace.task
    trial = interpolate_gaps(trial).trial.until(task.horizon)
    if not trial.candidate or trial.finite_steps < 0:
        return None
    off, (own, _) = (
        task.model.difference(trial.began, task.start),
        workspace.candidate(trial.candidate),
    )
    states = _inside(task, trial.states[: trial.finite_steps + 1])
    noise = np.maximum(sample_noise(trial.until(len(states) - 1), own.predicted_states), 1e-9)
    far = [
        int(i) for i in np.argsort(-np.abs(off) / noise) if abs(off[i]) > START_IS_OFF * noise[i]
    ]
    if not far:
        return None
    # what the start costs, beside the scatter of single runs of about this cost
    cost = abs(task.utility(trial))
    if not np.isfinite(cost) or len(states) <= trial.finite_steps:
        cost = -own.predicted_utility
    contents = workspace.read()
    others = standing_of(workspace, contents, {trial.id})
    scatter = float(np.nan_to_num(np.sqrt(Repeats(others.history).near(-cost).variance)))
    change = _changes(workspace, trial, off)
    if abs(change) <= max(scatter, TOLD * cost):
        return None
    # a run that is better than the best from either start counts
    lead = task.utility(trial) - others.incumbent.utility if others.incumbent else np.nan
    (rms, runs), first = placing(workspace, contents, but=trial.id), far[0]
    usual = np.abs(off) <= START_IS_OFF * rms
    name, unit = list(task.model.states.items())[first]
    began, start, away = (Quantity(float(x[first]), unit) for x in (trial.began, task.start, off))
    facts: dict[str, Any] = {"ran": trial.candidate, "trial": trial.id, "change": change}
    facts |= {"state": name, "began": began, "start": start, "off": away}
    names = tuple(task.model.state_names[i] for i in far)
    if abs(change) > SPOILT * cost and not usual[far].all() and not min(lead, lead - change) > 0:
        return found("run.start_spoils", *names, **facts)
    if usual[first]:
        facts |= {"runs": runs, "rms": Quantity(float(rms[first]), unit)}
    return found("run.start", *names, **facts)


def placing(workspace: Folder, contents: Contents, but: str = "") -> tuple[Array, int]:
    """Return how far the latest runs of a task began off its start (rms, n), and how many they are.

    A run that was discarded counts too, since the robot was placed before it. The rms is estimated
    by the median, so that a misread log is no usual start; it is 0 of fewer than `FEWEST` runs.

    Args:
        workspace: the workspace with the runs.
        contents: what is stored in it.
        but: id of a run that is left out, since it is judged by the others.
    """
    task, stored = workspace.task, (*workspace.trials(), *workspace.aside_trials())
    own = {made.id for made in contents.candidates}
    runs = (
        one.trial
        for one in sorted(stored, key=lambda one: one.stored.number)
        if one.trial.candidate in own and one.stored.id != but
    )
    off = [task.model.difference(run.began, task.start) for run in runs if workspace.fits(run)]
    known = np.array([one for one in off if np.isfinite(one).all()][-LATEST:])
    if len(known) < FEWEST:
        return np.zeros(task.model.n), len(known)
    return np.asarray(MEDIAN_TO_STD * median(np.abs(known))), len(known)


def _inside(task: Task, states: Array) -> Array:
    """Return the states before they left [safety], at least a few; all if they never did."""
    assert task.safety_low is not None and task.safety_high is not None
    out = ((states < task.safety_low) | (states > task.safety_high)).any(axis=1)
    return states[: max(int(np.argmax(out)), STEPS_TO_JUDGE)] if out.any() else states


def _changes(workspace: Folder, trial: Trial, off: Array) -> float:
    """Return by how much a start that is off by `off` (n,) changes the utility in the model."""
    policy = workspace.candidate(trial.candidate)[0].policy
    return float(np.nan_to_num(worth_of_start(workspace.planner, policy, off), nan=-np.inf))
