"""ingest: check, resample and store logs of the real system.

A trial written by grounded is stored byte for byte. A foreign log is mapped to the states and
inputs of the model ([log]), sampled on the control grid, and stored as a trial that names its
source by hash; the log itself stays where it is. The same input gives the same bytes, so that a
second ingest finds the first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.model import Model
from grounded.result import listed
from grounded.search.candidate import Candidate, Tried
from grounded.search.returned.as_predicted import odd_columns
from grounded.search.returned.misused import WITHOUT, without_feedback
from grounded.search.returned.other_scale import other_units, unit_named, units_tried
from grounded.search.returned.who_drove import OTHERS, Following
from grounded.search.safety import COASTS
from grounded.task import Task
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.logs.log_files import kind_of
from grounded_trials.store.own_files import CANDIDATE, TRIAL
from grounded_trials.store.store import DIGITS, Added
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import sha256
from grounded_trials.workspace.intake.after_run import afterwards
from grounded_trials.workspace.intake.asked_again import no_longer
from grounded_trials.workspace.intake.begun import begun_elsewhere
from grounded_trials.workspace.intake.earlier_task import OfEarlierTask, of_earlier_task
from grounded_trials.workspace.intake.ended_early import ended_early
from grounded_trials.workspace.intake.gone_wrong import gone_wrong
from grounded_trials.workspace.intake.handed_over import old_samples
from grounded_trials.workspace.intake.ingested import Ingested
from grounded_trials.workspace.intake.log_faults import dead_sensors, log_faults, mistaken_in
from grounded_trials.workspace.intake.look import Look
from grounded_trials.workspace.intake.misused_run import exactly_misused, misused_in
from grounded_trials.workspace.intake.odd_run import odd_run
from grounded_trials.workspace.intake.read_otherwise import (
    misled,
    pace_of,
    rather_exchanged,
    unit_of,
    units_told,
    zero_in,
)
from grounded_trials.workspace.intake.reading import (
    NoneWaits,
    Read,
    copied,
    cut_short,
    is_stored,
    misread,
    read_log_file,
    read_own_trial,
)
from grounded_trials.workspace.intake.run_start import (
    LOOSE,
    Recording,
    doubtful,
    loosely,
)
from grounded_trials.workspace.intake.skipped_steps import steps_skipped
from grounded_trials.workspace.intake.stored_before import (
    as_stored,
    estimated_otherwise,
    repeated,
    what_repeats,
)
from grounded_trials.workspace.intake.swung import swung
from grounded_trials.workspace.intake.trial_check import warnings_about
from grounded_trials.workspace.next_step import after_log
from grounded_trials.workspace.off_target import off_target_of, traded
from grounded_trials.workspace.proposing import candidate_named, latest_candidates, standing_in
from grounded_trials.workspace.unknown_id import refuse_ids

ASIDE = "set aside"  # the verdict on a run that does not count
WHOLE = 0.9  # share of a run that a log must last to be one, or else the error says so
EXACT = 0.1  # largest difference, relative to the resolution of commands, of an exact match


def ingest_log(
    workspace: Folder,
    path: Path,
    candidate: str | None = None,
    *,
    data: bool = False,
    ahead: bool = False,
) -> Ingested:
    """Check a log and store it as a trial, see `Workspace.ingest`; store nothing on an error.

    With `ahead` the next candidate is planned if the next command depends on it, see `standing_in`.
    """
    refuse_ids(workspace, path, "ingest")
    candidate = candidate and candidate_named(workspace, candidate)
    kind = "" if path.is_dir() else kind_of(path)
    if kind == CANDIDATE:
        raise GroundedError(f"{path} is a candidate, the policy to run, not the trial of its run")
    if candidate is not None and data:
        raise GroundedError("--data is for a log that ran no candidate; omit it or --candidate")
    if kind == TRIAL:
        read = read_own_trial(workspace, path, candidate, data)
    else:
        try:
            read = read_log_file(workspace, path, candidate, data)
        except NoneWaits as error:
            raise _by_its_commands(workspace, path, error) from None
    read = copied(workspace, path, read, "" if data else candidate)
    read = _recognised(workspace, path, read, candidate)
    if read.log and (other := estimated_otherwise(workspace, read.log)):
        read = replace(read, notes=(*read.notes, *other))
    if read.log and read.log.stored:
        read = replace(read, data=as_stored(workspace, read.log, read.trial, read.data))
    before = "" if read.copy else repeated(workspace, path, read.trial, read.data)
    with ExitStack() as new:  # nothing is stored if judging the trial fails
        added = new.enter_context(workspace.store.adding(read.data, again=before != ""))
        if read.bare:  # record which candidate file it ran
            ran = sha256(workspace.candidate_bytes(read.trial.candidate))
            note = {"note": "run", "trial": added.sha256[:DIGITS], "sha256": ran}
            new.enter_context(workspace.notes.adding(note))
        workspace.forget_trials()
        return _judged(workspace, read, added, before, ahead=ahead)


def _judged(workspace: Folder, read: Read, added: Added, before: str, *, ahead: bool) -> Ingested:
    """Return the result for a trial that was just stored: warnings, verdict, next command."""
    workspace.forget_trials()
    trial = replace(read.trial, id=added.id)
    faults = log_faults(workspace, interpolate_gaps(trial).trial)
    odd = tuple(one.told(trial, own=read.own) for one in faults)
    scaled = [name for one in faults for name in one.inputs]
    elsewhere = begun_elsewhere(workspace, trial)
    checked = warnings_about(workspace, trial, read.last_s, read.fell, scaled)
    warnings = (*read.warnings, *odd, *([elsewhere.told] if elsewhere else []), *checked)
    if before:
        warnings = (*warnings, f"it repeats {before} to the last bit: {what_repeats(workspace)}")
    if aside := added.id in workspace.discarded():
        warnings = (*warnings, f"{added.id} stays set aside and does not count: {_undo(added.id)}")
    now = standing_in(workspace) if trial.candidate else None
    history = now.history if now else ()
    tried = next((t for t in history if t.candidate.id == trial.candidate), None)
    verdict = ASIDE if aside else _verdict(trial, tried, workspace.config.search.repeats)
    slow = "" if read.doubted else steps_skipped(workspace, trial)
    warnings = (*filter(None, [slow]), *warnings)
    wrong = bool(slow) or (elsewhere is not None and elsewhere.again)
    if not (odd or wrong or aside):
        asked = gone_wrong(workspace, interpolate_gaps(trial).trial, tried, history)
        if asked:
            warnings, wrong = (asked.said, *warnings), asked.aside
    early = None if read.fell or aside or wrong else ended_early(workspace, trial)
    if early:
        said = (early.said,)  # after what is doubtful about the log, which may be why
        warnings, wrong = (*warnings, *said) if read.doubted else (*said, *warnings), early.aside
    if trial.candidate and not wrong and (whole := _whole(read, workspace.task)):
        warnings = (*warnings, *afterwards(workspace.planner, whole))
    if not (odd or wrong or aside):
        warnings = (*warnings, *swung(workspace.task, tried, trial, history))
    if ahead and verdict == "run again":
        now = standing_in(workspace, ahead=True)
    judged = [interpolate_gaps(trial).trial] if trial.candidate else []
    rest = [one for one in history if one is not tried and one.accepted]
    outdone = max(rest, key=lambda one: one.utility, default=None)
    best = tried is not None and now is not None and now.incumbent is tried
    told = traded(workspace.task, tried, outdone) if best and tried and outdone else ""
    return Ingested(
        trial=added.id,
        sha256=added.sha256,
        known=added.known,
        candidate=trial.candidate,
        utility=workspace.task.utility(judged[0]) if judged else None,
        accepted=tried.accepted if tried else None,
        warnings=warnings,
        faults=odd,
        signals=read.signals,
        verdict=verdict,
        crashed=tried.failed if tried and verdict == "crashed" else (),
        notes=(
            *read.notes,
            *filter(None, [told]),
            *(no_longer(workspace, added.id, now) if now and not added.known else ()),
            *(odd_run(workspace, now, added.id) if now and read.doubted else ()),
        ),
        off_target=off_target_of(workspace.task, judged),
        then=NextCommand("discard", (added.id,))
        if (odd or wrong) and not aside
        else after_log(workspace, verdict, now),
    )


def _by_its_commands(workspace: Folder, path: Path, error: NoneWaits) -> GroundedError:
    """Return the error with the command that fits the log: the best, another candidate, or data."""
    if not error.best:
        return error
    try:
        _recognised(workspace, path, read_log_file(workspace, path, error.best, False), None)
    except OfEarlierTask as refused:
        return refused
    except GroundedError as refused:
        return GroundedError(str(error), refused.then)
    return error


def _whole(read: Read, task: Task) -> Trial | None:
    """Return a complete run of a foreign log with the seconds that follow it, else None."""
    log = read.log.recording if read.log else None
    if log is None or read.cut is None or read.trial.steps < task.horizon:
        return None
    more = replace(log, steps=task.horizon + math.ceil(COASTS / task.dt))
    return more.trial_from(1e-9 * (read.cut.start_ns - log.whole.origin_ns))


def _recognised(workspace: Folder, path: Path, read: Read, candidate: str | None) -> Read:
    """Refuse a log whose commands are not its candidate's; only warn if the user named a candidate.

    A foreign log without a [log.span] may begin before the run: it is cut where the run begins.

    Raises:
        GroundedError: if it is not a run of its candidate, with what it is instead if known.
    """
    ran = read.trial.candidate
    if not ran or (is_stored(workspace, read.data) and not (read.log and not read.log.stored)):
        return read  # a log whose trial is set aside is examined again
    (own, _), candidates = workspace.candidate(ran), _may_have_run(workspace)
    logs = [read.log]
    if read.log and (late := read.log.as_seen):  # its program may have acted on these samples
        logs.append(late)
    looks = [Look(read, one, own, candidates, workspace.task) for one in logs]
    look = min(looks, key=lambda one: one.doubt)
    if look.read.log and look.read.cut:  # states may be unknown when the run begins
        look.read.log.refuse_late(look.read.cut)
    read, log, found, whole, seen = look.read, look.log, look.found, look.whole, look.suspicion
    if found and found.alike:
        loose = found.loose_s > LOOSE * workspace.task.dt and not look.exact
        unsure = filter(None, [loosely(found.loose_s, ran) if loose else "", doubtful(found, ran)])
        read = replace(read, warnings=(*read.warnings, *unsure))
    if look.old is not None:
        aged = old_samples(workspace, own, whole, look.old)
        read = replace(read, notes=(*read.notes, *aged))
    why, other = seen.why, seen.other
    fell, stored = look.fell, read.log.stored if read.log else ()
    task = workspace.task
    if accepted := [one.trial.steps for one in stored if one.trial.candidate == ran]:
        return cut_short(read, fell.steps, "") if fell and fell.steps in accepted else read
    units, by = other_units(task, whole, own, seen.ran)
    units = units if not other and not _guessed(log) & {*units} else ()
    if read.log and not why and not units:
        logged = [name for name in task.model.state_names if name not in _guessed(log)]
        tried = [(names, f) for names, f in units_tried(task.model) if {*names} <= {*logged}]
        units, by = odd_columns(task.model, own, whole, tried)
    if not why and not units:
        if candidate is None and log and (off := zero_in(log, task, own, whole, seen.ran)):
            raise GroundedError(f"{path} ran {ran}, but {off}")
        told = _unfed(own, whole, seen.ran) or _like(read, ran, seen.ran)
        if fell:
            read = cut_short(read, fell.steps, fell.told)
        return replace(read, warnings=(*read.warnings, *told))
    passed = exactly_misused(log, task, own) if log and why and not other else ""
    if passed and candidate is None:
        raise _misused(path, own, passed)
    slow = pace_of(log, task, own) if log and not other else None
    if slow:  # a recording at another rate may look like one in another unit
        units = ()
    elif log and not units and not other:
        units, by = unit_of(log, task, own)
    if log and units and why and rather_exchanged(log, task, own, units, by):
        units = ()
    if fell and not (units or slow or misled(log, task, own)):
        return cut_short(read, fell.steps, fell.told)
    pace = slow and (
        f"a second of its stamps is {slow:g} s of the run (a recording played at another rate?): "
        f"multiply the stamps by {slow:g} and ingest it again"
    )
    if candidate is not None:
        seem = f"with {listed(units)} times {by:.6g} it is its run: another unit, or sign?"
        gone = passed and f"its commands are not what {ran} sends on the logged states: {passed}"
        also = gone or misled(None if other else log, task, own)
        doubts = [seem if units else pace or also or why]
        if log and not (found and found.opens_alike):
            doubts.append(
                f"no start of {ran} was found in it: the run is assumed to begin with the first "
                f"command, at {log.first:.3f} s; set another with [log.span] start = SECONDS"
            )
        return replace(read, warnings=(*read.warnings, *doubts), doubted=True)
    if units:
        its = log and _in_programs_unit(task.model, units, by)
        if log and its and (how := misused_in(log, task, own)):
            raise _misused(path, own, how)
        other_unit = units_told(task, units, by, read.log is not None)
        raise GroundedError(f"{path} ran {ran}, {other_unit}")
    if pace:
        raise GroundedError(f"{path} ran {ran}, but {pace}")
    if read.bare:
        raise GroundedError(
            f"{path} says that it ran {ran}, but contains no copy of it, and {why}. If it ran the "
            f"{ran} of another workspace, ingest it there. Ingest it with --data for fitting and "
            f"diagnosis, or with --candidate {ran} anyway",
            NextCommand("ingest", (str(path), "--data")),
        )
    if not other and (left := of_earlier_task(workspace, log, whole)):
        raise OfEarlierTask(
            f"{path} ran {left}, which was made for an earlier task (other target, reward, limits, "
            "start or horizon): its utility can't be compared. Ingest it with --data for fitting "
            "and diagnosis, and run a candidate of this task",
            NextCommand("ingest", (str(path), "--data")),
        )
    known = replace(read.trial, id="").until(read.trial.known_steps)
    odd = []
    if not seen.silent:  # without them the model can't tell what moves the robot
        odd += [*mistaken_in(workspace.base_model, known)]
        odd += [*dead_sensors(workspace.base_model, whole)]
    named = [*(misread(read.log) if read.log else ())]
    named += [one.told(known, own=read.own) for one in odd]
    if not named and not other and not seen.silent:
        named += filter(None, [misled(log, task, own)])
    if named:
        raise GroundedError(f"{path} can't be read as a run of {ran}: {'; '.join(named)}")
    if log and not other and whole.inputs.any() and (how := misused_in(log, task, own)):
        raise _misused(path, own, how)
    said = f"{path} did not run {ran}: {why}{'' if why.endswith('?') else '.'}"
    if guessed := sorted(_guessed(log)):
        said += (
            f" Or {listed(guessed)}, which [estimate] finds here, {_is(guessed)} not what "
            "its program used: make it log its own estimate, and map that in [log] too."
        )
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
        f"on the logged states and times; {told}, and run {own.id} again. Ingest it with "
        "--data for fitting and diagnosis",
        NextCommand("ingest", (str(path), "--data")),
    )


def _lasting(log: Recording, task: Task) -> str:
    """Return a sentence on a log that is too short for a run of the task, or ""."""
    end = min(int(one.t.max()) for one in log.logged.values())
    lasts = 1e-9 * (end - log.whole.origin_ns) - log.first
    if not lasts < WHOLE * task.horizon * task.dt:
        return ""
    return (
        f" It ends {max(lasts, 0.0):.2g} s after its first command, while a run lasts "
        f"{task.horizon * task.dt:.3g} s: was its beginning or its end cut off?"
    )


def _guessed(log: Recording | None) -> set[str]:
    """Return the states that [estimate] finds: no column holds them, so none is in another unit."""
    return {name for name in log.names[0] if name not in log.logged} if log else set()


def _undo(identity: str) -> str:
    return f"`restore {identity}` undoes that"


def _is(names: Sequence[str]) -> str:
    return "is" if len(names) == 1 else "are"


def _may_have_run(workspace: Folder) -> list[Candidate]:
    """Return the latest candidates, preceded by the best one, which may still be on the robot."""
    latest = latest_candidates(workspace, OTHERS)
    if len(workspace.candidate_ids()) <= OTHERS:
        return latest
    best = standing_in(workspace).incumbent
    known = best is None or best.candidate.id in [one.id for one in latest]
    return latest if known or best is None else [best.candidate, *latest]


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


def _verdict(trial: Trial, tried: Tried | None, repeats: int) -> str:
    if tried is None:
        return "probe" if trial.candidate else ""
    again = tried.accepted and trial.id not in [one.id for one in tried.trials[:repeats]]
    return "run again" if again else tried.verdict()
