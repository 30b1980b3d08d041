"""Tell of a run that started away from [task] start, and whether that spoils its utility.

By how much a start changes the utility, the model says: it runs the candidate from there and from
s_0. A run whose utility it changes much says nothing about its candidate, and must be run again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.accounts.sent import LEAST
from grounded.findings import Finding, Quantity, found
from grounded.frozen import Array
from grounded.search.difference import student
from grounded.search.scatter import Repeats, sample_noise
from grounded.search.starts import worth_of_start
from grounded.task import Task
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.workspace.candidates.at_rest import SAME, standstills
from grounded_trials.workspace.candidates.standing_without import standing_without
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.off_target import began_elsewhere
from grounded_trials.workspace.placing import FEWEST, Placing, placing

# share of the mean cost of a step above which a start away from s_0 brings a warning; for a state
# without weight along the way, share of its range in the run
FAR = 0.1
SURE = 3.0  # the start must also be off by this many times sensor noise, and earlier starts' rms
CHANCE = 0.99865  # the same for the rms of few starts, as a probability by Student's t
MUCH = 1.0  # share of a mean step's cost from which earlier starts that scatter are no excuse
WORSE = 10.0  # times the promised cost: beside a worse run every offset would seem small
SPOILT = 0.2  # share of the run's cost by which the start changes it too much,
UNKNOWN = 0.5  # and by which it does while too few other runs tell how the robot is placed
TOLD = 0.05  # the same from which the change is told of a start that spoils nothing
ALWAYS = 3  # runs that begin alike, from which on they always do


def begun_elsewhere(workspace: Folder, trial: Trial) -> Finding | None:
    """Return in which states a run did not start at s_0, beyond sensor noise; None if in none.

    It spoils the utility if by the model it changes much of it, or by more than the run lost to the
    best candidate, unless the search repeats it for that. A change below the scatter of single runs
    spoils nothing. Offsets as other starts have them (`placing`) are unavoidable: a repeat would
    begin no nearer, and the search allows for what they cost. Before enough runs tell, a start
    spoils a run if it explains most of what it cost: a boat that was always placed to 5 cm had its
    first three runs discarded.

    Args:
        workspace: the workspace with the task, the model and the earlier runs.
        trial: the trial as stored.
    """
    task = workspace.task
    trial = interpolate_gaps(trial).trial.until(task.horizon)
    if not trial.candidate or trial.finite_steps < 0:
        return None
    off = task.model.difference(trial.began, task.start)
    if always := _always_there(workspace, trial, off):
        return always
    if (far := _far_off(workspace, trial, off)) is None:
        return None
    cost = abs(task.utility(trial))
    if not np.isfinite(cost) or far.failed:
        cost = -_promised(workspace, trial)
    lost, scatter = _lost_by(workspace, trial), _scatter(workspace, trial, cost)
    placed, repeats = placing(workspace, but=trial.id), _to_repeat(workspace, trial)
    unknown, perhaps = max(placed.runs) < FEWEST, _perhaps(off, placed)
    within = np.abs(off) <= SURE * np.nan_to_num(placed.rms)
    spoils, counts, usual = list[int](), list[int](), False
    for i in far.states:
        changes = _changes(workspace, trial, off * (np.arange(len(off)) == i))
        explains = 0 < lost < -changes and not repeats
        if abs(changes) > scatter and (abs(changes) > SPOILT * cost or explains):
            open_ = (unknown or perhaps[i]) and abs(changes) < UNKNOWN * cost
            as_others = bool(within[i]) or (open_ and not unknown)
            usual |= as_others
            (counts if as_others or open_ else spoils).append(i)
        elif not within[i] or far.share[i] > MUCH:
            counts.append(i)
    if not (spoils or counts):
        return None
    whole = _changes(workspace, trial, off)
    i = (*spoils, *counts)[0]
    facts = {"ran": trial.candidate, "trial": trial.id, **_placed(task, trial, i, off[i])}
    if abs(whole) > max(scatter, TOLD * cost):
        facts["change"] = whole
    names = tuple(task.model.state_names[k] for k in (*spoils, *counts))
    if spoils:
        return found("run.start_spoils", *names, **facts)
    if usual and not repeats:
        unit = list(task.model.states.values())[i]
        facts |= {"runs": int(placed.runs[i]), "rms": Quantity(float(placed.rms[i]), unit)}
    return found("run.start", *names, again=repeats, unknown=unknown, **facts)


@dataclass(frozen=True)
class _Far:
    """The states in which a run began off s_0 by more than noise, the most costly first."""

    states: list[int]
    share: Array  # (n,) of the cost of a mean step; without weight, of the range in the run
    failed: bool  # the run left [safety]


def _far_off(workspace: Folder, trial: Trial, off: Array) -> _Far | None:
    """Return in which states a start is far off, by `off` (n,); None if in none.

    A state that [reward] weighs along the way is judged by the cost of its offset relative to a
    mean step of the run (of one much worse than promised, WORSE times a promised step), another one
    relative to its range in the run. Of a run that left [safety], only the part before counts: a
    robot on the floor makes every start seem near.
    """
    task = workspace.task
    states = _inside(task, trial.states[: trial.finite_steps + 1])
    predicted = workspace.candidate(trial.candidate)[0].predicted_states
    noise = sample_noise(trial.until(len(states) - 1), predicted)
    known = -task.rewards(trial)[: len(states)]
    known = known[np.isfinite(known)]
    usually = known.sum() / max(len(known), 1)
    promised = -_promised(workspace, trial) / max(task.horizon, 1)
    usually = min(usually, WORSE * promised) if promised > 0 else usually
    weight = task.reward.state
    with np.errstate(all="ignore"):
        share = np.where(
            weight > 0, weight * off**2 / usually, np.abs(off) / np.ptp(states, axis=0)
        )
    clear = np.abs(off) > np.maximum(SURE * noise, 1e-9)
    told = (share > FAR) & clear
    order = sorted(np.flatnonzero(told).tolist(), key=lambda i: (weight[i] == 0, -share[i]))
    return _Far(order, share, len(states) <= trial.finite_steps) if order else None


def _perhaps(off: Array, placed: Placing) -> Array:
    """Return in which states a start may be off as other runs' starts are, (n,) bool.

    Of two other starts the rms says little: a boat that is placed to 5 cm began 5 and 14 mm off,
    and 77 mm were "unusual".
    """
    pairs = zip(np.abs(off), placed.rms, placed.runs, strict=True)
    return np.array([r > 0 and student(x / r, float(n)) <= CHANCE for x, r, n in pairs], bool)


def _placed(task: Task, trial: Trial, i: int, off: float) -> dict[str, Any]:
    """Return where one state started, and by how much that is off."""
    name, unit = list(task.model.states.items())[i]
    began, start = (Quantity(float(x), unit) for x in (trial.began[i], task.start[i]))
    return {"state": name, "began": began, "start": start, "off": Quantity(float(off), unit)}


def _always_there(workspace: Folder, trial: Trial, off: Array) -> Finding | None:
    """Return that the robot never begins at a value that [task] start has; or None.

    All other logs of runs, and of driving from a standstill, then begin where this run did. One in
    which it stood is enough to show that, else `ALWAYS` runs are: two may begin alike by chance.

    Args:
        workspace: the workspace with the other logs.
        trial: the run.
        off: its first state less s_0 (n,).
    """
    task, given = workspace.task, workspace.config.task.start
    others = [one for one in workspace.task_trials() if one.id != trial.id]
    began = {one.id: one.began for one in others if one.candidate}
    stood = {one.trial: one.states for one in standstills(workspace) if one.trial not in began}
    stood.pop(trial.id, None)
    if not stood and len(began) + 1 < ALWAYS:
        return None
    first = trial.began
    apart = [task.model.difference(x, first) for x in (*began.values(), *stood.values())]
    same = np.all(np.abs(apart) <= SAME * np.abs(off), axis=0).tolist()
    predicted = workspace.candidate(trial.candidate)[0].predicted_states
    clearly = began_elsewhere(task, [trial.until(task.horizon)], predicted)
    names = task.model.state_names
    odd = [i for i, name in enumerate(names) if same[i] and name in clearly and name in given]
    if not odd:
        return None
    whole = {**given, **{names[i]: float(first[i]) for i in odd}}
    values = tuple(f"{name} = {value:.4g}" for name, value in whole.items())
    facts = _placed(task, trial, odd[0], off[odd[0]])
    others_too = (*stood, *began)
    return found(
        "run.start_always", *(names[i] for i in odd), others=others_too, values=values, **facts
    )


def _inside(task: Task, states: Array) -> Array:
    """Return the states before they left [safety], at least a few; all if they never did."""
    assert task.safety_low is not None and task.safety_high is not None
    out = ((states < task.safety_low) | (states > task.safety_high)).any(axis=1)
    return states[: max(int(np.argmax(out)), LEAST)] if out.any() else states


def _lost_by(workspace: Folder, trial: Trial) -> float:
    """Return by how much a run is worse than the best other candidate's mean; <= 0 if it is not."""
    task, each = workspace.task, dict[str, list[float]]()
    for one in workspace.task_trials():
        if one.candidate and one.candidate != trial.candidate:
            each.setdefault(one.candidate, []).append(task.utility(one))
    best = max((sum(some) / len(some) for some in each.values()), default=-np.inf)
    return float(best - task.utility(trial)) if np.isfinite(best) else 0.0


def _to_repeat(workspace: Folder, trial: Trial) -> bool:
    """Return whether a run's candidate is to be run again since its start explains its loss."""
    history = standing_without(workspace, ()).history
    return any(t.in_doubt and t.to_settle == t.candidate.id == trial.candidate for t in history)


def _scatter(workspace: Folder, trial: Trial, cost: float) -> float:
    """Return the std of single runs of about this cost, by repeats among the others; 0 if unknown.

    Args:
        workspace: the workspace with the other runs.
        trial: the run, whose own start must not count as scatter.
        cost: what such runs cost.
    """
    others = standing_without(workspace, {trial.id}).history
    return float(np.nan_to_num(np.sqrt(Repeats(others).near(-cost).variance)))


def _changes(workspace: Folder, trial: Trial, off: Array) -> float:
    """Return by how much a start that is off by `off` (n,) changes the utility in the model."""
    policy = workspace.candidate(trial.candidate)[0].policy
    return float(np.nan_to_num(worth_of_start(workspace.planner, policy, off), nan=-np.inf))


def _promised(workspace: Folder, trial: Trial) -> float:
    return workspace.candidate(trial.candidate)[0].predicted_utility
