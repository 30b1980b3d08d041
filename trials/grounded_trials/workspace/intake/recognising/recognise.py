"""Refuse a log whose commands are not those of its candidate, and say what it is instead.

A log may be the run of another candidate, of one of an earlier task that was left on the robot, or
of its own one read in another unit, at another rate or from exchanged columns; or the robot's
program passed its candidate the wrong things. Each is tried before a log is refused, so that the
error names the remedy. A user who names the candidate gets a warning instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.model import Model
from grounded.policy import Policy
from grounded.result import listed
from grounded.search.candidate import Candidate
from grounded.search.returned.as_predicted import odd_columns
from grounded.search.returned.misused import WITHOUT, without_feedback
from grounded.search.returned.other_scale import (
    THOUSAND,
    of_full_scale,
    other_units,
    unit_named,
    units_tried,
)
from grounded.search.returned.who_drove import (
    OTHERS,
    Following,
    follows,
    latest,
)
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.workspace.candidates.search_state import latest_candidates, standing_in
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import other_task
from grounded_trials.workspace.intake.locating.missed_steps import other_clock
from grounded_trials.workspace.intake.locating.run_start import Recording, Start
from grounded_trials.workspace.intake.opening.reading import (
    NoneWaits,
    Read,
    cut_log,
    cut_short,
    is_stored,
    misread,
    read_log_file,
)
from grounded_trials.workspace.intake.recognising.look import Look
from grounded_trials.workspace.intake.recognising.misused_run import (
    cut_in,
    exactly_misused,
    misused_in,
    other_origin,
)
from grounded_trials.workspace.intake.recognising.read_otherwise import (
    Misled,
    crossed,
    exchanged_in,
    misled,
    pace_of,
    rather_exchanged,
    times_too,
    unit_of,
    units_told,
    zero_in,
)
from grounded_trials.workspace.intake.remarks.control_loop import old_samples
from grounded_trials.workspace.intake.remarks.log_faults import (
    column_faults,
    without,
)

if TYPE_CHECKING:
    from grounded.accounts.table import Account

WHOLE = 0.9  # share of a run that a log must last to be one, or else the error says so
EXACT = 0.1  # largest difference, relative to the resolution of commands, of an exact match
NEAR = 0.05  # largest mean difference from the policy's commands, relative to an input's size
ENDED = ("stopped", "converged")  # phases of a search
LOOSE = 0.1  # uncertainty of a start, in steps, above which a warning is given


def best_run_again(workspace: Folder, path: Path, error: NoneWaits) -> Read:
    """Return a log as another run of the best candidate, if the search ended and it clearly is one.

    Raises:
        GroundedError: `error` if not, with the command that fits the log: the best, another
            candidate, or data.
    """
    if not error.best:
        read = read_log_file(workspace, path, None, True)
        _refuse_earlier(workspace, path, read.log.recording if read.log else None, read.trial)
        raise error
    try:
        read = read_log_file(workspace, path, error.best, False)
        seen = recognised(workspace, path, read, None, remedies=False)
    except OfEarlierTask:
        raise
    except GroundedError as refused:
        raise GroundedError(str(error), refused.then) from None
    doubts = set(seen.warnings) - {*read.warnings}  # about where it begins, or whose it is
    if doubts or standing_in(workspace, ahead=True).phase not in ENDED:
        raise error
    note = (
        f"no candidate is waiting for a trial; its commands are those of {error.best}, the best: "
        "it counts as another run of it"
    )
    return replace(read, notes=(note, *read.notes))


def recognised(
    workspace: Folder, path: Path, read: Read, candidate: str | None, *, remedies: bool = True
) -> Read:
    """Refuse a log whose commands are not its candidate's; only warn if the user named a candidate.

    A foreign log without a [log.span] may begin before the run: it is cut where the run begins.

    Args:
        workspace: the workspace with the candidates.
        path: the log, for messages.
        read: what it contains.
        candidate: the candidate that the user named, if any.
        remedies: find out why it seems to be nobody's run, which takes a minute for a long log.

    Raises:
        GroundedError: if it is not a run of its candidate, with what it is instead if known.
    """
    ran = read.trial.candidate
    if not ran or (is_stored(workspace, read.data) and not (read.log and not read.log.stored)):
        return read  # a log whose trial is set aside is examined again
    (own, _), (candidates, earlier) = workspace.candidate(ran), _may_have_run(workspace)
    logs = [read.log]
    if read.log and (late := read.log.as_seen):  # its program may have acted on these samples
        logs.append(late)
    looks = [Look(read, one, own, [*earlier, *candidates], workspace.task) for one in logs]
    look = min(looks, key=lambda one: one.doubt)
    if look.read.log and look.read.cut:  # states may be unknown when the run begins
        look.read.log.refuse_late(look.read.cut)
    read, log, found, whole, seen = look.read, look.log, look.found, look.whole, look.suspicion
    if found and found.alike:
        loose = found.loose_s > LOOSE * workspace.task.dt and not look.exact
        unsure = filter(None, [loosely(found.loose_s, ran) if loose else "", doubtful(found, ran)])
        read = replace(read, warnings=(*read.warnings, *unsure))
    if look.old is not None:
        read = replace(read, aged=tuple(old_samples(workspace, own, whole, look.old)))
    why, other = seen.why, seen.other
    fell, stored = look.fell, read.log.stored if read.log else ()
    task = workspace.task
    again = NextCommand("ingest", (str(path) if read.log else "LOG",))  # LOG: of another run
    if accepted := [one.trial.steps for one in stored if one.trial.candidate == ran]:
        return cut_short(read, fell.steps, "") if fell and fell.steps in accepted else read
    rival = next((one for one in (*earlier, *candidates) if one.id == other), None)
    unstored = replace(read.trial, id="")

    def proven(fault: Account) -> list[str]:
        return without(workspace, unstored, fault)

    @cache  # it takes seconds
    def swapped() -> Misled | None:
        return exchanged_in(log, task, own, proven) if log else None

    swap = crossed(log, task, own, rival, proven) if rival else None
    if swap and candidate is None:
        raise _unreadable(path, ran, [swap.said], _then(again, swap))
    if rival in earlier and candidate is None:
        raise _of_earlier_task(workspace, path, other)
    units, by = other_units(task, whole, own, seen.ran)
    units = units if not other and not _guessed(log) & {*units} else ()
    if read.log and not why and not units:
        logged = [name for name in task.model.state_names if name not in _guessed(log)]
        tried = [(names, f) for names, f in units_tried(task.model) if {*names} <= {*logged}]
        units, by = odd_columns(task.model, own, whole, tried)
    if cut := cut_in(log, own, found) if log and (why or units) and not other else "":
        units, why = (), why or f"its commands are not what {ran} sends: {cut}"
    if not why and not units:
        if candidate is None and log and (off := zero_in(log, task, own, whole, seen.ran)):
            raise GroundedError(f"{path} ran {ran}, but {off}", again)
        told = _unfed(own, whole, seen.ran) or _like(read, ran, seen.ran)
        if fell:
            read = cut_short(read, fell.steps, fell.told)
        return replace(read, warnings=(*read.warnings, *told))
    if not remedies and why and not (other or fell):
        _refuse_earlier(workspace, path, log, whole)
        raise GroundedError(why, NextCommand("ingest", (str(path), "--data")))
    passed = cut
    if log and why and not (other or cut):
        passed = exactly_misused(log, task, own) or other_clock(log, own.policy)
    if passed and candidate is None:
        raise _misused(path, own, passed)
    slow = pace_of(log, task, own) if log and not (other or cut) else None
    if slow:  # a recording at another rate may look like one in another unit
        units = ()
    elif log and not (units or other or cut):
        units, by = unit_of(log, task, own)
    if log and units and why and rather_exchanged(log, task, own, units, by):
        units = ()
    if fell and not (units or slow or misled(log, task, own, swapped)):
        return cut_short(read, fell.steps, fell.told)
    pace = slow and (
        f"a second of its stamps is {slow:g} s of the run (a recording played at another rate?): "
        f"multiply the stamps by {slow:g} and ingest it again"
    )
    turned, exchange = "", None
    if log and whole.inputs.any() and not (units or slow or other or (found and found.opens_alike)):
        exchange = swapped()  # one turns inputs round, as the model sees
        turned = "" if exchange else turned_in(workspace, log, ran)
    if candidate is not None:
        seem = f"with {listed(units)} times {by:.6g} it is its run: another unit, or sign?"
        gone = passed and f"its commands are not what {ran} sends on the logged states: {passed}"
        hides = exchange or misled(log, task, own, swapped)
        hides = swap if other else None if turned or gone else hides
        origin = ""
        if log and why and not (units or pace or other or turned or gone or hides):
            origin = other_origin(log, task.model, own)
        gone = gone or (origin and f"its commands are not what {ran} sends: {origin}")
        also = turned or gone or (hides.said if hides else "")
        doubts = [seem if units else pace or also or why]
        if log and not (found and found.opens_alike):
            read, assumed = _from_first_change(read, log, task)
            run = task.horizon * task.dt
            longer = f", though the log goes on for {_lasting_s(log) - run:.3g} s longer than a run"
            doubts.append(
                f"no start of {ran} was found in it: the run is assumed to begin where the "
                f"commands first change, at {assumed:.3f} s"
                f"{longer * (WHOLE * _lasting_s(log) > run)}; set another with [log.span] start = "
                "SECONDS"
            )
        opens = found and found.opens_alike
        unread = not (opens or other or units or pace or passed or seen.silent)
        foreign = log and unread and seen.ran and seen.ran.foreign and not seen.ran.opens
        aside = doubts[0] if turned or foreign or gone else ""
        return replace(read, warnings=(*read.warnings, *doubts), doubted=True, aside=aside)
    if units:
        its = log and _in_programs_unit(task.model, units, by)
        if log and its and (how := misused_in(log, task, own)):
            raise _misused(path, own, how)
        if by == -1 and (shown := sent_reversed(workspace, whole, units)):
            raise GroundedError(
                f"{path}: only with {listed(units)} of the other sign are its commands those of "
                f"{ran}, {shown}. Mend that and run {ran} again",
                NextCommand("next", ("LOG",)),
            )
        if by != -1 and (shown := sent_scaled(workspace, units, by)):
            raise GroundedError(
                f"{path} ran {ran}, but {shown}. Mend that and run {ran} again",
                NextCommand("next", ("LOG",)),
            )
        other_unit = units_told(task, units, by, read.log is not None)
        raise GroundedError(f"{path} ran {ran}, {other_unit}", again)
    if pace:
        raise GroundedError(f"{path} ran {ran}, but {pace}", again)
    if read.bare:
        raise GroundedError(
            f"{path} says that it ran {ran}, but contains no copy of it, and {why}. If it ran the "
            f"{ran} of another workspace, ingest it there. Ingest it with --data for fitting and "
            f"diagnosis, or with --candidate {ran} anyway",
            NextCommand("ingest", (str(path), "--data")),
        )
    if not other:
        _refuse_earlier(workspace, path, log, whole)
    if turned:
        raise GroundedError(
            f"{path} can't be read as a run of {ran}: {turned}. Ingest it with --candidate {ran} "
            "only if that is how the robot should be",
            NextCommand("export", (ran, "--runner")),
        )
    known = replace(read.trial, id="").until(read.trial.known_steps)
    odd, hides = [], exchange  # by its commands, which tell a log's fault from the robot's
    if not (seen.silent or exchange):  # without them the model can't tell what moves the robot
        odd += column_faults(workspace, known)
    named = [*(misread(read.log) if read.log and not exchange else ())]
    named += [one.told(known, own=read.own) for one in odd]
    if not (named or other or seen.silent or hides):
        hides = misled(log, task, own, swapped)
    if hides:
        named, again = [hides.said], _then(again, hides)
    if named:
        raise _unreadable(path, ran, named, again)
    if log and not other and whole.inputs.any() and (how := misused_in(log, task, own)):
        raise _misused(path, own, how)
    if log and not other and (how := other_origin(log, task.model, own)):
        raise _misused(path, own, how)
    if guessed := sorted(_guessed(log)):  # the likeliest reason
        differs, _, rather = why.partition("; ")
        why = (
            f"{differs}. Perhaps {listed(guessed)}, which [estimate] finds here, {_is(guessed)} "
            "not what its program used: let it log its own, and map that in [log] too"
            f"{'. Or ' * bool(rather)}{rather}"
        )
    said = f"{path} did not run {ran}: {why}{'' if why.endswith('?') else '.'}"
    said += read.hole + (_lasting(log, task) if log else "")
    if other:
        raise GroundedError(
            f"{said} Ingest it with --candidate {other}, with --candidate {ran} anyway, or with "
            "--data for fitting and diagnosis only",
            NextCommand("ingest", (str(path), "--candidate", other)),
        )
    begins = "; set where the run begins with [log.span] start = SECONDS" * (read.log is not None)
    raise GroundedError(
        f"{said} Ingest it with --data for fitting and diagnosis, or with --candidate {ran} "
        f"anyway{begins}",
        NextCommand("ingest", (str(path), "--data")),
    )


def _unreadable(path: Path, ran: str, why: Sequence[str], then: NextCommand) -> GroundedError:
    return GroundedError(f"{path} can't be read as a run of {ran}: {'; '.join(why)}", then)


def _then(again: NextCommand, fault: Misled) -> NextCommand:
    """Return the command after a log with a fault: for the same log, or that of the next run."""
    return NextCommand("next", ("LOG",)) if fault.rerun else again


def _refuse_earlier(workspace: Folder, path: Path, log: Recording | None, trial: Trial) -> None:
    """Raise OfEarlierTask if a log is the run of a candidate of an earlier task."""
    if left := of_earlier_task(workspace, log, trial):
        raise _of_earlier_task(workspace, path, left)


def _of_earlier_task(workspace: Folder, path: Path, ran: str) -> OfEarlierTask:
    was = other_task(workspace.task, workspace.candidate(ran)[0])
    return OfEarlierTask(
        f"{path} ran {ran}, which was made for an earlier task ({was}): its utility can't be "
        "compared. Ingest it with --data for fitting and diagnosis, and run a candidate of this "
        "task; or change the task back, then ingest it",
        NextCommand("ingest", (str(path), "--data")),
    )


def turned_in(workspace: Folder, log: Recording, ran: str) -> str:
    """Return that an input acted the other way round in a log without a run of its candidate.

    Feedback with the wrong sign drives the states away from the prediction, so that the commands
    soon stay at their limits and do not tell where the run began.

    Args:
        workspace: the workspace with the model.
        log: the log.
        ran: the candidate that it is said to have run.

    Returns:
        What shows it, and what to do: the end of a sentence; "" if nothing does.
    """
    from grounded.search.returned.reversed_input import reversed_input

    trial = log.trial_from(log.first)
    if trial is None or not (found := reversed_input(workspace.planner, trial)):
        return ""
    return (
        f"{found.said}. Is it wired the wrong way round? Then mend that and run {ran} again: with "
        f"the feedback reversed this was not its run. If only the log has the other sign, set "
        f"scale = -1 in [log.input.{found.input}] and ingest it again"
    )


def sent_reversed(workspace: Folder, trial: Trial, names: Sequence[str]) -> str:
    """Return that a program sent inputs with the other sign, which the log shows as they were sent.

    Args:
        workspace: the workspace with the model.
        trial: the log, as it is read.
        names: signals of which only the opposite is what the candidate sends.

    Returns:
        What shows it: the end of a sentence; "" if it may be the log that has the other sign.
    """
    from grounded.accounts.judge import contradicted
    from grounded.accounts.table import Account

    model = workspace.base_model
    if not {*names} <= {*model.input_names}:
        return ""
    columns = tuple(model.n + model.input_names.index(name) for name in names)
    fault, known = Account("sign", columns, -1.0), trial.until(trial.known_steps)
    as_logged, mended = (
        contradicted(model, one, range(model.n), fault, constant=False)
        for one in (known, fault.mended(known))
    )
    program = f"so its program sends {listed(names)} times -1"
    if as_logged:
        return f"but the robot moved as the log says, {program}"
    if mended or not without(workspace, replace(trial, id=""), fault):
        return ""
    return f"but earlier logs, read in the same way, have the right one, {program}"


def sent_scaled(workspace: Folder, names: Sequence[str], by: float) -> str:
    """Return that a program sent inputs times a number that is no unit, as earlier runs show.

    They were read in the same way and had what their candidates send. Another scale in the log
    would spoil every later one.

    Args:
        workspace: the workspace with the earlier runs.
        names: signals that have to be multiplied for the candidate's commands.
        by: the number.

    Returns:
        A clause; "" if the log may have another unit, or there are no earlier runs.
    """
    task = workspace.task
    known = unit_named(task.model, names, by) or of_full_scale(task, names, by)
    earlier = any(one.candidate for one in workspace.task_trials(measured=True))
    if not {*names} <= {*task.model.input_names} or known or by in THOUSAND or not earlier:
        return ""
    tables = listed(f"[log.input.{name}]" for name in names)
    return (
        f"its program sends {listed(names)} {times_too(by)}: earlier runs, whose logs were read in "
        f"the same way, have the right size (if it is the log that changed since, multiply the "
        f"scale in {tables} by {by:.6g})"
    )


def _from_first_change(read: Read, log: Recording, task: Task) -> tuple[Read, float]:
    """Cut a run of unknown start where the commands first change, if a whole run follows.

    Returns:
        The run, and where it begins, in seconds after the log's first sample.
    """
    changes, run = log.changes[log.changes > log.first], task.horizon * task.dt
    begins = float(changes.min(initial=np.inf))
    late = begins - log.first
    if read.log is None or not task.dt <= late <= _lasting_s(log) - WHOLE * run:
        return read, log.first
    return cut_log(read.log, read.trial.candidate, begins), begins


def _in_programs_unit(model: Model, names: Sequence[str], by: float) -> bool:
    """Return whether rather the robot's program than its log has states in another unit.

    No unit has numbers that are smaller than radians by 57.3; but if a program works in degrees,
    that is the ratio of the log to what it passed, for all angles and their rates.
    """
    mine = {model.states.get(name, "") for name in names}
    turning = {name for name, unit in model.states.items() if unit.split("/")[0] in mine}
    known = unit_named(model, names, 1 / by) and not unit_named(model, names, by)
    return bool(known) and turning <= {*names}


def _misused(path: Path, own: Candidate, told: str) -> GroundedError:
    """Return the error that the robot's program misused its candidate, with the remedy."""
    return GroundedError(
        f"{path} did not run {own.id} as it should: its commands are not what {own.id} sends "
        f"on the logged states and times; {told}, and run {own.id} again. This log serves fitting "
        f"and diagnosis: `ingest --data {path}`",
        NextCommand("next", ("LOG",)),
    )


def _lasting(log: Recording, task: Task) -> str:
    """Return a sentence on a log that is too short for a run of the task, or ""."""
    lasts = _lasting_s(log)
    if not lasts < WHOLE * task.horizon * task.dt:
        return ""
    return (
        f" It ends {max(lasts, 0.0):.2g} s after its first command, while a run lasts "
        f"{task.horizon * task.dt:.3g} s: was its beginning or its end cut off?"
    )


def _lasting_s(log: Recording) -> float:
    """Return how long a log lasts after its first command [s]."""
    end = min(int(one.t.max()) for one in log.logged.values())
    return 1e-9 * (end - log.whole.origin_ns) - log.first


def _guessed(log: Recording | None) -> set[str]:
    """Return the states that [estimate] finds: no column holds them, so none is in another unit."""
    return {name for name in log.names[0] if name not in log.logged} if log else set()


def _is(names: Sequence[str]) -> str:
    return "is" if len(names) == 1 else "are"


def _may_have_run(workspace: Folder) -> tuple[list[Candidate], list[Candidate]]:
    """Return the candidates that may still be on the robot: of the task, and of earlier ones.

    They are the latest ones. Those of the task are preceded by the best; those of earlier tasks
    have as many steps as a run of this one.
    """
    task, (latest, earlier) = workspace.task, latest_candidates(workspace, OTHERS)
    earlier = [one for one in earlier if _like_task(one.policy, task)]
    if len(workspace.candidate_ids()) <= OTHERS:
        return latest, earlier
    best = standing_in(workspace).incumbent
    if best is not None and best.candidate.id not in [one.id for one in latest]:
        latest = [best.candidate, *latest]
    return latest, earlier


def _like(read: Read, ran: str, found: Following | None) -> tuple[str, ...]:
    """Return a warning if a trial's commands are not exactly its policy's: another workspace's?"""
    if not read.bare or found is None or np.nanmax(np.abs(found.off) / found.fine) < EXACT:
        return ()
    return (
        f"its commands are like those of {ran}, but not the same, and it contains no copy of what "
        f"it ran: if that was the {ran} of another workspace, `discard` it. To be sure, write "
        "trials with TrialWriter(..., policy=Path(candidate).read_bytes())",
    )


def _unfed(own: Candidate, run: Trial, found: Following | None) -> tuple[str, ...]:
    """Return a warning if a run, little disturbed, was driven without its candidate's feedback."""
    if found is None or not without_feedback(own, run, found):
        return ()
    return (f"its commands are the feed-forward of {own.id} alone, {WITHOUT}",)


def _like_task(policy: Policy, task: Task) -> bool:
    """Return whether a policy has the steps, states and inputs of a task."""
    names = (task.model.state_names, task.model.input_names)
    return (policy.dt, policy.horizon, policy.state_names, policy.input_names) == (
        task.dt,
        task.horizon,
        *names,
    )


class OfEarlierTask(GroundedError):
    """Raised for a log that ran a candidate of an earlier task."""


def of_earlier_task(workspace: Folder, log: Recording | None, trial: Trial) -> str:
    """Return the candidate of an earlier task whose commands a trial has, or "".

    Args:
        workspace: the workspace with the candidates.
        log: the foreign log of the trial, in which a run may begin anywhere; else None.
        trial: the trial, with gaps bridged.
    """
    least, name, task = NEAR, "", workspace.task
    void = []
    for identity in workspace.candidate_ids():
        with suppress(GroundedError):  # a damaged file can't have been run
            candidate, meta = workspace.candidate(identity)
            void += [candidate] * (meta.get("task") != task.hash)
    for one in reversed(void[-OTHERS:]):
        if log is not None:
            start = log.start_of(one.policy)
            apart = start.apart if start is not None and start.alike else NEAR
        else:
            fit = follows(one.policy, trial.until(one.policy.horizon), latest(task))
            apart = fit.error if fit is not None and fit.alike else NEAR
        if apart < least:
            least, name = apart, one.id
    return name


def doubtful(found: Start, ran: str) -> str:
    """Return the warning for a start beside which another one fits about as well; or ""."""
    if found.rival_s is None:
        return ""
    return (
        f"where {ran} begins is in doubt: its commands fit about as well from {found.rival_s:.3f} "
        f"s of the log on as from {found.seconds:.3f} s, which is used. If the run began "
        "elsewhere, or the log has several, `discard` it and set [log.span] start = SECONDS"
    )


def loosely(seconds: float, ran: str) -> str:
    """Return the warning for a start that feedback does not determine within a row."""
    return (
        f"the start of the run is only known to {1e3 * seconds:.3g} ms, the time between rows of "
        f"the log: its commands are not exactly what {ran} sends on the logged states. Log the "
        "states that the controller used (no velocities differentiated or filtered afterwards), or "
        "the time at which it sent each command"
    )
