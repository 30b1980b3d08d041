"""Tell of a run that started away from [task] start, and whether that spoils its utility.

By how much a start changes the utility, the model says: it runs the candidate from there and from
s_0. A run whose utility it changes much says nothing about its candidate, and must be run again;
unless it is better than the best from either start.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from grounded.accounts.sent import STEPS_TO_JUDGE
from grounded.findings import Finding, Quantity, found
from grounded.frozen import Array
from grounded.search.candidate import Tried
from grounded.search.difference import Repeats, worth_of_start
from grounded.search.noise import sample_noise
from grounded.task import Task
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.workspace.candidates.search_state import standing_of
from grounded_trials.workspace.folder import Folder

START_IS_OFF = 3.0  # times sensor noise, and earlier starts' rms, by which a start must be off
# share of the run's cost by which the start changes it: told, and too much to count; and that
# while too few other runs tell how the robot is placed
TOLD, SPOILT, UNKNOWN = 0.05, 0.2, 0.5
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
    off = task.model.difference(trial.began, task.start)
    own, _ = workspace.candidate(trial.candidate)
    states = _inside(task, trial.states[: trial.finite_steps + 1])
    noise = sample_noise(trial.until(len(states) - 1), own.predicted_states)
    far = np.flatnonzero(np.abs(off) > np.maximum(START_IS_OFF * noise, 1e-9))
    if not len(far):
        return None
    cost = abs(task.utility(trial))
    if not np.isfinite(cost) or len(states) <= trial.finite_steps:
        cost = -own.predicted_utility
    others = standing_of(workspace, workspace.read(), {trial.id})
    least = max(_scatter(others.history, cost), TOLD * cost)
    each = {int(i): abs(_changes(workspace, trial, off * (np.arange(len(off)) == i))) for i in far}
    told = sorted((i for i in each if each[i] > least), key=lambda i: -each[i])
    if not told:
        return None
    (rms, runs), whole = placing(workspace, but=trial.id), _changes(workspace, trial, off)
    unknown = runs < FEWEST
    usual = np.abs(off) <= START_IS_OFF * rms
    most = (UNKNOWN if unknown else SPOILT) * cost
    facts = {
        "ran": trial.candidate,
        "trial": trial.id,
        **_placed(task, trial, told[0], off[told[0]]),
    }
    facts |= {"change": whole} if abs(whole) > least else {}
    names = tuple(task.model.state_names[i] for i in told)
    best = others.incumbent
    lead = np.nan if best is None else task.utility(trial) - best.utility
    stands = min(lead, lead - whole) > 0  # better than the best from either start
    if any(each[i] > most and not usual[i] for i in told) and not stands:
        return found("run.start_spoils", *names, **facts)
    repeats = _to_repeat(workspace, trial)
    if usual[told[0]] and not repeats:
        unit = list(task.model.states.values())[told[0]]
        facts |= {"runs": runs, "rms": Quantity(float(rms[told[0]]), unit)}
    return found("run.start", *names, again=repeats, unknown=unknown, **facts)


def placing(workspace: Folder, but: str = "") -> tuple[Array, int]:
    """Return how far the latest runs of a task began off its start (rms, n), and how many they are.

    A run that was discarded counts too, since the robot was placed before it. The rms is estimated
    by the median, so that a misread log is no usual start; it is 0 of fewer than `FEWEST` runs.

    Args:
        workspace: the workspace with the runs.
        but: id of a run that is left out, since it is judged by the others.
    """
    task, stored = workspace.task, (*workspace.trials(), *workspace.aside_trials())
    own = {made.id for made in workspace.read().candidates}
    runs = (
        one.trial
        for one in sorted(stored, key=lambda one: one.stored.number)
        if one.trial.candidate in own and one.stored.id != but
    )
    off = [task.model.difference(run.began, task.start) for run in runs if workspace.fits(run)]
    known = np.array([one for one in off if np.isfinite(one).all()][-LATEST:])
    if len(known) < FEWEST:
        return np.zeros(task.model.n), len(known)
    return np.asarray(MEDIAN_TO_STD * np.median(np.abs(known), axis=0)), len(known)


def _placed(task: Task, trial: Trial, i: int, off: float) -> dict[str, Any]:
    """Return where one state started, and by how much that is off."""
    name, unit = list(task.model.states.items())[i]
    began, start = (Quantity(float(x), unit) for x in (trial.began[i], task.start[i]))
    return {"state": name, "began": began, "start": start, "off": Quantity(float(off), unit)}


def _inside(task: Task, states: Array) -> Array:
    """Return the states before they left [safety], at least a few; all if they never did."""
    assert task.safety_low is not None and task.safety_high is not None
    out = ((states < task.safety_low) | (states > task.safety_high)).any(axis=1)
    return states[: max(int(np.argmax(out)), STEPS_TO_JUDGE)] if out.any() else states


def _to_repeat(workspace: Folder, trial: Trial) -> bool:
    """Return whether a run's candidate is to be run again since its start explains its loss."""
    history = standing_of(workspace, workspace.read()).history
    return any(t.in_doubt and t.to_settle == t.candidate.id == trial.candidate for t in history)


def _scatter(others: Sequence[Tried], cost: float) -> float:
    """Return the std of single runs of about this cost, by repeats among the others; 0 if unknown.

    Args:
        others: the history without the run, whose own start must not count as scatter.
        cost: what such runs cost.
    """
    return float(np.nan_to_num(np.sqrt(Repeats(others).near(-cost).variance)))


def _changes(workspace: Folder, trial: Trial, off: Array) -> float:
    """Return by how much a start that is off by `off` (n,) changes the utility in the model."""
    policy = workspace.candidate(trial.candidate)[0].policy
    return float(np.nan_to_num(worth_of_start(workspace.planner, policy, off), nan=-np.inf))
