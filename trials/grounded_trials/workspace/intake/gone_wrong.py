"""Ask whether a run went as it should: sent or begun otherwise, reversed, astray, ended early.

A motor wired the wrong way round, an encoder that slipped or a hand on the robot give a faultless
log of a run that says nothing about its candidate. The next plan would be based on it. A log of
other driving is asked about as well: with another that contradicts it, no diagnosis is possible.

A run whose commands are its candidate's to the last digits, and whose motion is near its
prediction, came about as it is logged: no story of its log or of its program is asked for then.

A log does not tell whether the robot crashed at its end, somebody stopped it, or only the recording
ended. But a robot that crashes leaves its prediction or [safety] first. If it was as near to its
prediction at the end as before, and was not about to leave [safety], the candidate should not count
as failed: the next plan would shrink from it.

By how much a start away from [task] start changes the utility, the model says: it runs the
candidate from there and from s_0. A run whose utility it changes much says nothing about its
candidate, and must be run again; unless it is better than the best from either start.

`ingest` asks once, `status` again (`proposing.unanswered`), until the user has decided: the trial
is discarded, or restored, or a candidate was handed out after it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from grounded.accounts.sent import (
    LATEST,
    SAME,
    STEPS_TO_JUDGE,
    UNLIKE,
    as_planned,
    follows,
    latest,
    like_predicted,
)
from grounded.findings import Finding, Quantity, Weight, found
from grounded.frozen import Array, median
from grounded.search.candidate import Candidate, Tried
from grounded.search.difference import Repeats, worth_of_start
from grounded.search.noise import sample_noise
from grounded.task import Task
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.workspace.candidates.search_state import standing_of
from grounded_trials.workspace.folder import Contents, Folder
from grounded_trials.workspace.last_diagnosis import diagnosable

SIGN_ASKED_FROM = 10.0  # times what runs miss otherwise: from here on an input's sign is asked
STRAYED = 100.0  # the same, from where on a run went far astray
NO_CRASH = 0.05  # of a state's range in the prediction: a smaller distance from it is no crash
GROWN = 1.5  # times as far from the prediction at the end as before: farther off is no usual end
START_IS_OFF = 3.0  # times sensor noise, and earlier starts' rms, by which a start must be off
TOLD, SPOILT = 0.05, 0.5  # share of the run's cost by which the start changes it: told; too much
FEWEST = 2  # runs from which it is told how exactly the robot is placed
MEDIAN_TO_STD = 1.4826  # of the size of a normal variable
RECENT = 50  # runs that are looked at; the way of placing a robot may change
# last steps, in most of which a state has to be that far off: noise is not
END = STEPS_TO_JUDGE // 2


def gone_wrong(
    workspace: Folder,
    trial: Trial,
    tried: Tried | None,
    history: Sequence[Tried],
    *,
    planned: bool = False,
) -> Finding | None:
    """Return what seems wrong with a trial: an input reversed, or a run that went far astray.

    Args:
        workspace: the workspace with the model.
        trial: the trial as stored, with short gaps bridged.
        tried: its candidate with all of its runs; None if it ran none.
        history: all candidates with their runs.
        planned: it came about as it is logged.
    """
    run, missed, usual = trial, 0.0, 1.0
    others = [t for t in history if t.utilities and t is not tried and math.isfinite(t.utility)]
    if tried:
        run, missed = trial.until(workspace.task.horizon), tried.promised
        missed -= workspace.task.utility(trial)
        usual = max(abs(tried.promised), 1e-9)
    if others:  # what the best one cost, and what runs miss otherwise
        cost = min(abs(t.utility) for t in others)
        off = np.array([abs(t.promised - t.utility) for t in others])
        usual = max(usual, cost, float(median(off)))
    if not planned:
        from grounded.search.run_motion import reversed_input

        astray = missed > SIGN_ASKED_FROM * usual
        if turned := reversed_input(workspace.planner, run, astray=astray):
            return _is_it_wired(workspace, trial, turned)
    if tried and others and STRAYED * usual < missed < math.inf:
        ran, times = tried.candidate.id, missed / usual
        return found("run.astray", ran=ran, trial=trial.id, missed=missed, times=times)
    return None


def ran_otherwise(workspace: Folder, trial: Trial) -> Finding | None:
    """Return how a program ran its candidate otherwise than planned; None if it did not.

    Commands that are some steps late in a log were sent late or logged late: commands and states
    alone do not tell which.

    Args:
        workspace: the workspace with the task and the candidate.
        trial: the trial as stored.
    """
    from grounded.accounts.returned import Kind, stories  # of runs that are not as planned

    if not trial.candidate:
        return None
    task, (own, _) = workspace.task, workspace.candidate(trial.candidate)
    run = interpolate_gaps(trial).trial.until(task.horizon)
    ran = follows(own.policy, run, max(LATEST, latest(task)))
    some = stories(task, own, run, ran)
    if some and some[0].kind is Kind.PROGRAM:
        return some[0].finding
    if ran is None or not (ran.alike and ran.late and ran.moved < UNLIKE):
        return None
    # the states acted on show a wrong start
    late, side = ran.late, "late" if ran.late > 0 else "early"
    start = late < 0 or ran.age <= SAME * late
    what = "start" if start else "either"
    return found("log.late", ran=own.id, steps=abs(late), side=side, what=what)


def _is_it_wired(workspace: Folder, trial: Trial, turned: Finding) -> Finding:
    """Return that an input acted the other way round, given the other trials.

    If it did so in all of them, the model has the wrong sign: no run is at fault.
    """
    from grounded.search.run_motion import signs_of

    each = [
        (one.id, signs_of(workspace.planner, one)[turned.about[0]])
        for one in diagnosable(workspace)
        if one.id != trial.id
    ]
    right, wrong = (tuple(name for name, sign in each if sign == s) for s in (1, -1))
    said = turned.also(others=right, alike=() if right else wrong)
    if right or (trial.candidate and not wrong):
        return said.also(trial=trial.id)
    return said.weighing(Weight.WARN)


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
    known = np.array([one for one in off if np.isfinite(one).all()][-RECENT:])
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


def ended_early(workspace: Folder, trial: Trial, silent: Sequence[str] = ()) -> Finding | None:
    """Return that a run ended early; None if it did not.

    Args:
        workspace: the workspace with the task and the candidates.
        trial: the trial as stored.
        silent: states without a value in the rest of its log, where others have some.
    """
    task, run = workspace.task, interpolate_gaps(trial).trial
    if not run.candidate or run.steps >= task.horizon or run.whole(task.horizon) is not run:
        return None
    own, _ = workspace.candidate(run.candidate)
    complete = tuple(
        one.id
        for one in workspace.task_trials()
        if one.candidate == own.id and one.whole(task.horizon).finite_steps >= task.horizon
    )
    return found(
        "run.early" if as_before(task, own, run) else "run.failed",
        ran=own.id,
        trial=run.id,
        steps=run.steps,
        horizon=task.horizon,
        silent=tuple(silent),
        complete=complete,
    )


def as_before(task: Task, own: Candidate, run: Trial) -> bool:
    """Return whether a run was as near to its prediction at its end as before, inside [safety].

    A robot that crashes stays off its prediction. Noise, and what feedback makes of it, moves one
    state or another off it farther than ever before, but only for a moment.

    Args:
        task: with [safety].
        own: the candidate that was run.
        run: its run, shorter than the task.
    """
    if run.finite_steps < max(run.steps, 2 * STEPS_TO_JUDGE) or not like_predicted(own, run):
        return False
    said = own.predicted_states
    off = np.abs(task.model.difference(run.states, said[: len(run.states)]))
    known = np.maximum(GROWN * off[:-STEPS_TO_JUDGE].max(axis=0), NO_CRASH * np.ptp(said, axis=0))
    end = median(off[-END:])
    soon = (
        2 * run.states[-1] - run.states[-1 - STEPS_TO_JUDGE]
    )  # as many steps later, at the same rate
    assert task.safety_low is not None and task.safety_high is not None
    inside = [((x >= task.safety_low) & (x <= task.safety_high)).all() for x in run.states]
    inside.append(((soon >= task.safety_low) & (soon <= task.safety_high)).all())
    return bool(all(inside) and (end <= known).all())


def went_as_planned(workspace: Folder, trial: Trial) -> bool:
    """Return whether a trial, with gaps bridged, is a run as planned, see `as_planned`."""
    if trial.candidate not in workspace.candidate_ids():
        return False
    own, _ = workspace.candidate(trial.candidate)
    return as_planned(own, trial.until(own.policy.horizon))


def shown_by(
    workspace: Folder,
    trial: Trial,
    tried: Tried | None,
    history: Sequence[Tried],
    *,
    own: bool,
    doubted: bool = False,
    silent: Sequence[str] = (),
) -> Iterator[Finding | None]:
    """Yield what a stored trial shows of its log, its program, its start and its run.

    Args:
        workspace: the workspace with the task and the candidates.
        trial: the trial as stored.
        tried: its candidate with all of its runs; None if it ran none.
        history: all candidates with their runs.
        own: it was written by grounded, and not read through [log].
        doubted: its candidate was named against its commands.
        silent: states without a value in the rest of its log, where others have some.
    """
    whole = interpolate_gaps(trial).trial
    planned = went_as_planned(workspace, whole)
    if not planned:
        from grounded_trials.workspace.intake.log_faults import log_faults

        yield from log_faults(workspace, whole, own=own)
        yield None if doubted else ran_otherwise(workspace, trial)
    yield begun_elsewhere(workspace, trial)
    yield gone_wrong(workspace, whole, tried, history, planned=planned)
    yield ended_early(workspace, trial, silent)
