"""Ask whether a run went as it should: an input reversed, far astray, or ended early.

A motor wired the wrong way round, an encoder that slipped or a hand on the robot give a faultless
log of a run that says nothing about its candidate. The next plan would be based on it. A log of
other driving is asked about as well: with another that contradicts it, no diagnosis is possible.

A log does not tell whether the robot crashed at its end, somebody stopped it, or only the recording
ended. But a robot that crashes leaves its prediction or [safety] first. If it was as near to its
prediction at the end as before, and was not about to leave [safety], the candidate should not count
as failed: the next plan would shrink from it.

`ingest` asks once, `status` again (`unanswered`), until the user has decided: the trial is
discarded, or restored, or a candidate was handed out after it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from grounded.errors import NextCommand
from grounded.result import listed
from grounded.search.candidate import Candidate
from grounded.search.returned.as_predicted import like_predicted
from grounded.search.returned.who_drove import LEAST
from grounded.search.step.mispredictions import STRAYED
from grounded.task import Task
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.wording import ranges
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import StoredTrial
from grounded_trials.workspace.intake.remarks.control_loop import ran_otherwise
from grounded_trials.workspace.intake.remarks.initial_state import begun_elsewhere
from grounded_trials.workspace.intake.remarks.lagging import lagging
from grounded_trials.workspace.intake.remarks.log_faults import log_faults
from grounded_trials.workspace.last_diagnosis import diagnosable
from grounded_trials.workspace.read_before import paths_of, read_by

if TYPE_CHECKING:
    from grounded.search.candidate import Tried
    from grounded.search.returned.reversed_input import Reversed

FAR = 10.0  # times what runs miss otherwise: from here on an input's sign is asked
NEAR = 0.05  # of a state's range in the prediction: a smaller distance from it is no crash
GROWN = 1.5  # times as far from the prediction at the end as before: farther off is no usual end
END = LEAST // 2  # last steps, in most of which a state has to be that far off: noise is not


@dataclass(frozen=True)
class Asked:
    """A question about a trial, and whether it is to be set aside unless the answer is no."""

    said: str
    aside: bool = True


def gone_wrong(
    workspace: Folder, trial: Trial, tried: Tried | None, history: Sequence[Tried]
) -> Asked | None:
    """Return a question about a trial with an input reversed, or a run that went far astray.

    Args:
        workspace: the workspace with the model.
        trial: the trial as stored, with short gaps bridged.
        tried: its candidate with all of its runs; None if it ran none.
        history: all candidates with their runs.

    Returns:
        None if nothing is wrong with it.
    """
    from grounded.search.returned.reversed_input import beside_friction, reversed_input

    others = [t for t in history if t.utilities and t is not tried and math.isfinite(t.utility)]
    missed, usual = _missed(workspace, trial, tried, others) if tried else (0.0, 1.0)
    astray = missed > FAR * usual
    run = trial.until(workspace.task.horizon) if trial.candidate else trial
    found = (reversed_input if astray else beside_friction)(workspace.planner, run)
    if found:
        return _is_it_wired(workspace, trial, found)
    odd = _unlike_its_runs(workspace, trial, tried) if tried is not None else ""
    if odd:
        return Asked(odd)
    if tried is None or not (others and astray and STRAYED * usual < missed < math.inf):
        return None
    return Asked(
        f"it missed its prediction by {missed:,.3g}, {missed / usual:,.3g} times what runs miss or "
        "cost otherwise: did it run as it should? If not (a motor, a sensor, somebody in the way), "
        f"`discard {trial.id}` and run {tried.candidate.id} again; if it did, `propose` goes on"
    )


def _unlike_its_runs(workspace: Folder, trial: Trial, tried: Tried) -> str:
    """Return the question about a run that cost many times what its candidate's others did; ""."""
    each = zip(tried.trials, tried.utilities, strict=True)
    others = {one.id: -u for one, u in each if one.id != trial.id and math.isfinite(u)}
    cost, most = -workspace.task.utility(trial), max(others.values(), default=math.inf)
    if not (most > 0 and FAR * most < cost < math.inf):
        return ""
    name, runs = tried.candidate.id, "other run" if len(others) == 1 else "worst other run"
    return (
        f"it cost {cost:,.3g}, {cost / most:,.2g} times as much as the {runs} of {name} "
        f"({ranges([*others])}): did it run as it should? If not (the program, a motor, a sensor, "
        f"somebody in the way), `discard {trial.id}` and run {name} again; if it did, `propose` "
        "goes on"
    )


def _missed(
    workspace: Folder, trial: Trial, tried: Tried, others: Sequence[Tried]
) -> tuple[float, float]:
    """Return by how much a run missed its promised utility, and what runs miss otherwise."""
    usual = max(
        abs(tried.promised),
        min((abs(t.utility) for t in others), default=0.0),
        float(np.median([abs(t.promised - t.utility) for t in others])) if others else 0.0,
        1e-9,
    )
    return tried.promised - workspace.task.utility(trial), usual


def _is_it_wired(workspace: Folder, trial: Trial, found: Reversed) -> Asked:
    """Return the question about an input that acted the other way round, given the other trials."""
    from grounded.search.returned.reversed_input import signs_of

    each = [
        (one.id, signs_of(workspace.planner, one)[found.input])
        for one in diagnosable(workspace)
        if one.id != trial.id
    ]
    right, wrong = ([name for name, sign in each if sign == s] for s in (1, -1))
    again = f"mend it and run {trial.candidate} again" if trial.candidate else "mend it"
    if right and trial.candidate and _elsewhere(workspace, found.input, right):
        return Asked(
            f"{found.said}. [log.input.{found.input}] reads another column now than for "
            f"{ranges(right)}: is that right? If not, `discard {trial.id}`, correct it and ingest "
            "the log again; if it is, `propose` goes on"
        )
    if right:
        wired = f"Is it wired, or its sign switched, otherwise than in {ranges(right)}?"
        if not trial.candidate:
            return Asked(f"{found.said}. {wired} Then `discard {trial.id}` and {again}")
    elif trial.candidate:
        wired = "Is it wired the wrong way round, or is its sign in the model wrong?"
    else:
        told = "Is its sign in the log or in the model wrong? `diagnose` says what to change"
        return Asked(f"{found.said}. {told}", aside=False)
    like = f", as in {ranges(wrong)}" if wrong and not right else ""
    return Asked(
        f"{found.said}{like}. {wired} Then `discard {trial.id}`, {again}; if not, `propose` goes on"
    )


def _elsewhere(workspace: Folder, name: str, trials: Sequence[str]) -> bool:
    """Return whether [log] read an input of all of some trials from another column than now."""
    if workspace.log_mapping is None:
        return False
    own = paths_of(read_by(workspace.log_mapping), [name])
    metas = {one.stored.id: one.meta for one in workspace.whole_trials()}
    return all(paths_of(metas[one], [name]) not in ((), own) for one in trials if one in metas)


def ended_early(workspace: Folder, trial: Trial, silent: Sequence[str] = ()) -> Asked | None:
    """Return what a run that ended early counts as, and what to do; None if it did not.

    Args:
        workspace: the workspace with the task and the candidates.
        trial: the trial as stored.
        silent: states without a value in the rest of its log, where others have some.
    """
    task, run = workspace.task, interpolate_gaps(trial).trial
    if not run.candidate or run.steps >= task.horizon or run.whole(task.horizon) is not run:
        return None
    own, _ = workspace.candidate(run.candidate)
    name, part = own.id, f"{run.steps} of {task.horizon} steps ({run.steps * run.dt:.2f} s)"
    ends = f"all states are known for {part} only"
    why = "Was the recording cut off, or the robot stopped?"
    if silent:
        has = "has" if len(silent) == 1 else "have"
        ends += f", as {listed(silent)} {has} no values after that, though the log goes on"
        why = (
            f"Did the sensor of {listed(silent)} fail or lose the robot, or was the robot stopped?"
        )
    complete = _complete(workspace, run)
    before = f"{name} ran to the end before ({complete}). " if complete else ""
    if as_before(task, own, run):
        return Asked(
            f"{ends}; the robot was as near to its prediction there as before. {before}{why} Then "
            f"`discard {run.id}`, run {name} again and record it to its end. If it crashed there, "
            f"`propose` goes on: {name} counts as failed"
        )
    return Asked(
        f"the run ended after {part}: a failed candidate; its data stay usable for fit and "
        f"diagnose. {before}Use `discard {run.id}` if you stopped it for another reason, or if "
        "only the recording was cut off",
        aside=False,
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
    if run.finite_steps < max(run.steps, 2 * LEAST) or not like_predicted(own, run):
        return False
    said = own.predicted_states
    off = np.abs(task.model.difference(run.states, said[: len(run.states)]))
    known = np.maximum(GROWN * off[:-LEAST].max(axis=0), NEAR * np.ptp(said, axis=0))
    end = np.median(off[-END:], axis=0)
    soon = 2 * run.states[-1] - run.states[-1 - LEAST]  # as many steps later, at the same rate
    assert task.safety_low is not None and task.safety_high is not None
    inside = [((x >= task.safety_low) & (x <= task.safety_high)).all() for x in run.states]
    inside.append(((soon >= task.safety_low) & (soon <= task.safety_high)).all())
    return bool(all(inside) and (end <= known).all())


def _complete(workspace: Folder, run: Trial) -> str:
    """Return the runs of the same candidate that were complete, as text."""
    horizon = workspace.task.horizon
    return ", ".join(
        one.id
        for one in workspace.task_trials()
        if one.candidate == run.candidate and one.whole(horizon).finite_steps >= horizon
    )


def unanswered(workspace: Folder) -> tuple[tuple[str, ...], NextCommand | None]:
    """Return why the last trial should be discarded, a sentence each, and the command for it.

    Args:
        workspace: the workspace with the trials.

    Returns:
        (), None if nothing is wrong with it, if it ran another policy of a candidate's name, or if
        the user has decided.
    """
    last = next((one for one in reversed(workspace.trials()) if workspace.fits(one.trial)), None)
    if last is None or "~" in last.trial.candidate or _decided(workspace, last):
        return (), None
    trial, own, name = last.trial, "source" not in last.meta, last.stored.id
    if said := workspace.noted.asked.get(last.stored.digest, ""):
        unless = f"`discard {name}`, unless it ran {trial.candidate}; then `propose` goes on"
        why = f"{name}: {said}{'' if said.endswith('?') else '.'} {unless}"
        return (why,), NextCommand("discard", (name,))
    told = [one.told(trial, own=own) for one in log_faults(workspace, trial)]
    told += filter(
        None, [ran_otherwise(workspace, last.measured, lagging(workspace, last.measured))]
    )
    begun = begun_elsewhere(workspace, last.measured)
    told += [begun.told] if begun and begun.again else []
    if not told:
        from grounded_trials.workspace.candidates.search_state import standing_in

        history = standing_in(workspace).history
        tried = next((t for t in history if t.candidate.id == trial.candidate), None)
        wrong = gone_wrong(workspace, interpolate_gaps(trial).trial, tried, history)
        early = ended_early(workspace, last.measured)
        told = [one.said for one in (wrong, early) if one and one.aside][:1]
    then = NextCommand("discard", (name,)) if told else None
    return tuple(f"{name}: {one}" for one in told), then


def _decided(workspace: Folder, last: StoredTrial) -> bool:
    """Return whether a trial was restored, or a candidate handed out after it."""
    noted, stored = workspace.noted, last.stored
    after = max((int(name[1:].split("-")[0]) for name in noted.last if name), default=0)
    return after >= stored.number or bool({stored.path.stem, stored.digest} & noted.kept)
