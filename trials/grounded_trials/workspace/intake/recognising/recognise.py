"""Refuse a log whose commands are not those of its candidate, and say what it is instead.

A log may be the run of another candidate, of one of an earlier task that was left on the robot, or
of its own one read in another unit, at another rate or from exchanged columns; or the robot's
program passed its candidate the wrong things. Each is a story with a score; the likeliest is
told, with its remedy. A user who names the candidate gets a warning instead.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.model import Model
from grounded.policy import Policy
from grounded.result import listed
from grounded.search.candidate import Candidate
from grounded.search.returned.as_predicted import apart, odd_columns
from grounded.search.returned.misused import WITHOUT, without_feedback
from grounded.search.returned.other_scale import (
    THOUSAND,
    of_full_scale,
    other_units,
    unit_by_factor,
    units_tried,
)
from grounded.search.returned.who_drove import FINE, Following, follows, latest
from grounded.search.returned.whose_run import OTHERS
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.workspace.candidates.search_state import latest_candidates, standing_in
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import other_task
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
from grounded_trials.workspace.intake.recognising.misused_run import misused_in, misuses
from grounded_trials.workspace.intake.recognising.read_otherwise import (
    exchanged_in,
    in_unit,
    offset_in,
    otherwise,
    times_too,
    units_told,
)
from grounded_trials.workspace.intake.recognising.stories import (
    Kind,
    Story,
    likeliest,
    scored,
)
from grounded_trials.workspace.intake.remarks.control_loop import old_samples
from grounded_trials.workspace.intake.remarks.log_faults import Fault, column_faults, without

if TYPE_CHECKING:
    from grounded.accounts.table import Account

WHOLE = 0.9  # share of a run that a log must last to be one, or else the error says so
EXACT = 0.1  # largest difference, relative to the resolution of commands, of an exact match
NEAR = 0.05  # largest mean difference from the policy's commands, relative to an input's size
ENDED = ("stopped", "converged")  # phases of a search
SHORTER = 1.0  # [nats] that a fall costs
LOOSE = 0.1  # uncertainty of a start, in steps, above which a warning is given


def best_run_again(workspace: Folder, path: Path, error: NoneWaits) -> Read:
    """Return a log as another run of the best candidate, if the search ended and it clearly is one.

    Raises:
        GroundedError: `error` if not, with the command that fits the log: the best, another
            candidate, or data.
    """
    if not error.best:
        read = read_log_file(workspace, path, None, True)
        log = read.log.recording if read.log else None
        if earlier := of_earlier_task(workspace, log, read.trial):
            raise _of_earlier(workspace, path, earlier.names[0])
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


class Case:
    """A log that should be the run of a candidate, and all that stories of it are made from.

    Args:
        workspace: the workspace with the candidates.
        path: the log, for messages.
        read: what it contains.
        named: the candidate that the user named, if any.
    """

    def __init__(self, workspace: Folder, path: Path, read: Read, named: str | None) -> None:
        self.workspace, self.path, self.named, self.task = workspace, path, named, workspace.task
        self.ran, (self.own, _) = read.trial.candidate, workspace.candidate(read.trial.candidate)
        candidates, self.earlier = _may_have_run(workspace)
        logs = [read.log]
        if read.log and (late := read.log.as_seen):  # its program may have acted on these samples
            logs.append(late)
        rivals = [*self.earlier, *candidates]
        looks = [Look(read, one, self.own, rivals, self.task) for one in logs]
        look = self.look = min(looks, key=lambda one: one.doubt)
        self.read, self.log, self.whole, self.seen = look.read, look.log, look.whole, look.suspicion
        known = [] if read.bare else rivals  # resembling one of these may be coincidence
        self.rival = next((one for one in known if one.id == self.seen.other), None)
        self.again = NextCommand("ingest", (str(path) if self.read.log else "LOG",))
        self.guessed = _guessed(self.log)

    @property
    def opens(self) -> bool:
        """Whether at least the first commands are the candidate's, from the start found on."""
        return bool(self.look.found and self.look.found.opens_alike)

    @cached_property
    def as_logged(self) -> Story:
        """The story of a log that is as it should be: the rival's that evidence names, or nobody's.

        Candidates that are nearly the same send nearly the same on exchanged columns, too.
        """
        log, rival, why, kind = self.log, self.rival, self.seen.why, Kind.CANDIDATE
        if rival is None:
            error = self.seen.ran.error if self.seen.ran else 1.0
            return scored(Kind.UNKNOWN, why, self.own, self.whole, error)
        kind = Kind.EARLIER if rival in self.earlier else kind
        start = log.start_of(rival.policy, only_alike=True) if log else None
        run = log.trial_from(start.seconds) if log and start and start.alike else None
        fit = run and follows(rival.policy, run.until(rival.policy.horizon), 0)
        if run and fit:
            return scored(kind, why, rival, run, fit.error, names=(rival.id,))
        return Story(kind, why, commands=-np.inf, names=(rival.id,))

    @cached_property
    def columns(self) -> list[Fault]:
        """The faults of columns; none of them can be told without the commands."""
        trial, fell = replace(self.read.trial, id=""), self.look.fell
        known = trial.until(min(trial.known_steps, fell.steps if fell else trial.steps))
        untold = self.read.bare or self.seen.silent
        return [] if untold else column_faults(self.workspace, known)

    def proven(self, fault: Account) -> list[str]:
        """Return which stored trials, read by the same [log], contradict an exchange."""
        return without(self.workspace, replace(self.read.trial, id=""), fault)

    def warned(self) -> Read:
        """Return the trial with what is doubtful about where it begins, or about its samples."""
        read, found, look = self.read, self.look.found, self.look
        if read.log and read.cut:  # states may be unknown when the run begins
            read.log.refuse_late(read.cut)
        if found and found.alike:
            loose = found.loose_s > LOOSE * self.task.dt and not look.exact
            doubts = [loosely(found.loose_s, self.ran) if loose else "", doubtful(found, self.ran)]
            read = replace(read, warnings=(*read.warnings, *filter(None, doubts)))
        if look.old is not None:
            aged = old_samples(self.workspace, self.own, self.whole, look.old)
            read = replace(read, aged=tuple(aged))
        return read


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
    case = Case(workspace, path, read, candidate)
    read, fell = case.warned(), case.look.fell
    stored = read.log.stored if read.log else ()
    if accepted := [one.trial.steps for one in stored if one.trial.candidate == ran]:
        return cut_short(read, fell.steps, "") if fell and fell.steps in accepted else read
    alike = not case.seen.why
    story = likeliest(_of_trial(case), case.as_logged)
    if alike and story.kind is Kind.UNKNOWN:
        told = _unfed(case.own, case.whole, case.seen.ran) or _like(read, ran, case.seen.ran)
        read = cut_short(read, fell.steps, fell.told) if fell else read
        return replace(read, warnings=(*read.warnings, *told))
    if remedies or alike or case.rival or fell:
        story = likeliest([story, *_of_log(case)], case.as_logged)
    else:
        story = of_earlier_task(workspace, case.log, case.whole) or story
    if story.kind in (Kind.UNKNOWN, Kind.PROGRAM) and remedies:  # neither says how the robot moved
        story = next(_of_motion(case, story), story)
    if story.kind is Kind.FELL and fell:
        return cut_short(read, fell.steps, fell.told)
    if candidate is not None:
        return _doubted(case, read, story)
    raise REFUSED.get(story.kind, _told)(case, story)


def _of_trial(case: Case) -> Iterator[Story]:
    """Yield the stories of a trial as it is cut, of another unit or origin of its states."""
    task, own, whole, ran = case.task, case.own, case.whole, case.seen.ran
    if case.rival:
        return
    names, by = other_units(task, whole, own, ran)
    if names and not case.guessed & {*names}:
        yield in_unit(task, own, whole, names, by)
    elif case.log and not case.seen.why:
        logged = {name for name in task.model.state_names if name not in case.guessed}
        tried = [(names, f) for names, f in units_tried(task.model) if {*names} <= logged]
        names, by = odd_columns(task.model, own, whole, tried)
        if names:
            yield in_unit(task, own, whole, names, by)
        elif not case.named and (off := offset_in(case.log, task, own, whole, ran)):
            yield off


def _of_log(case: Case) -> Iterator[Story]:
    """Yield the stories of a log whose commands are not its candidate's."""
    log, task, own, fell = case.log, case.task, case.own, case.look.fell
    if case.rival:  # with the columns put back, the commands are those of the one that ran
        swaps = [exchanged_in(log, task, one, case.proven) for one in (own, case.rival) if log]
        yield from filter(None, swaps)
        return
    if fell and case.seen.ran:
        error = np.nanmean((case.seen.ran.off / case.seen.ran.fine)[: fell.steps] ** 2) ** 0.5
        part = case.whole.until(fell.steps)
        yield scored(Kind.FELL, fell.told, own, part, FINE * float(error), price=SHORTER)
    if log:
        yield from otherwise(log, task, own, case.proven)
        yield from misuses(log, task, own, case.look.found)
    if dead := [one for one in case.columns if one.kind == "dead"]:
        names = [name for one in dead for name in one.names]
        plain, motion = case.as_logged.commands, apart(own, case.whole, names)
        yield replace(next(_of_columns(case, dead)), commands=plain, motion=motion)
    earlier = None if case.read.bare else of_earlier_task(case.workspace, log, case.whole)
    if earlier:
        yield replace(earlier, said=case.seen.why)


def _of_motion(case: Case, story: Story) -> Iterator[Story]:
    """Yield what the motion tells of a log whose commands only a program explains, or nothing."""
    sent = case.log if case.whole.inputs.any() and not (case.rival or case.opens) else None
    if sent and (turned := turned_in(case.workspace, sent, case.ran)):
        yield replace(story, kind=Kind.ROBOT, said=turned)
    if story.kind is Kind.UNKNOWN:
        yield from _of_columns(case, case.columns)


def _of_columns(case: Case, odd: Sequence[Fault]) -> Iterator[Story]:
    """Yield the faults of columns that motion and kinematics show."""
    names = misread(case.read.log) if case.read.log else ()
    if odd or names:
        known = replace(case.read.trial, id="")
        said = "; ".join((*names, *(one.told(known, own=case.read.own) for one in odd)))
        yield Story(Kind.LOG, said, commands=-np.inf)


def _doubted(case: Case, read: Read, story: Story) -> Read:
    """Return the run of a candidate that the user named, with what is doubtful about it."""
    log, ran, task = case.log, case.ran, case.task
    said, program = story.said, story.kind is Kind.PROGRAM
    if story.kind is Kind.UNIT:
        said = f"with {listed(story.names)} times {story.by:.6g} it is its run: another unit, or "
        said += "sign?"
    elif program:
        said = f"its commands are not what {ran} sends on the logged states: {said}"
    doubts = [said]
    if log and not case.opens:
        read, assumed = _from_first_change(read, log, task)
        run = task.horizon * task.dt
        longer = f", though the log goes on for {_lasting_s(log) - run:.3g} s longer than a run"
        doubts.append(
            f"no start of {ran} was found in it: the run is assumed to begin where the "
            f"commands first change, at {assumed:.3f} s"
            f"{longer * (WHOLE * _lasting_s(log) > run)}; set another with [log.span] start = "
            "SECONDS"
        )
    by_hand = log and not (case.opens or case.rival or case.seen.silent)
    foreign = by_hand and case.seen.ran and case.seen.ran.foreign and not case.seen.ran.opens
    nobody = foreign and story.kind in (Kind.UNKNOWN, Kind.LOG)
    aside = said if program or nobody or story.kind is Kind.ROBOT else ""
    return replace(read, warnings=(*read.warnings, *doubts), doubted=True, aside=aside)


# --- how each kind of story refuses a log ---------------------------------------------------------


def _scaled(case: Case, story: Story) -> GroundedError:
    """Return the error of a log in another unit or of another sign, or of a program that is."""
    names, by, ran, log = story.names, story.by, case.ran, case.log
    its = log if _in_programs_unit(case.task.model, names, by) else None
    if its and (how := next(misused_in(its, case.task, case.own), None)):
        return _told(case, how)
    if shown := sent_otherwise(case.workspace, case.whole, names, by):
        sign = f": only with {listed(names)} of the other sign are its commands those of {ran}, "
        return GroundedError(
            f"{case.path}{sign if by == -1 else f' ran {ran}, '}{shown}. Mend that and run {ran} "
            "again",
            NextCommand("next", ("LOG",)),
        )
    other_unit = units_told(case.task, names, by, case.read.log is not None)
    return GroundedError(f"{case.path} ran {ran}, {other_unit}", case.again)


def _told(case: Case, story: Story) -> GroundedError:
    """Return the error of a log, program or robot with a fault, and the next command."""
    path, ran = case.path, case.ran
    then = NextCommand("next", ("LOG",)) if story.rerun else case.again
    if story.kind is Kind.PROGRAM:
        return GroundedError(
            f"{path} did not run {ran} as it should: its commands are not what {ran} sends "
            f"on the logged states and times; {story.said}, and run {ran} again. This log serves "
            f"fitting and diagnosis: `ingest --data {path}`",
            NextCommand("next", ("LOG",)),
        )
    if story.kind is Kind.PACE or not case.seen.why:
        return GroundedError(f"{path} ran {ran}, but {story.said}", then)
    said, anyway = f"{path} can't be read as a run of {ran}: {story.said}", ""
    if story.kind is Kind.ROBOT:
        anyway = f". Ingest it with --candidate {ran} only if that is how the robot should be"
        then = NextCommand("export", (ran, "--runner"))
    return GroundedError(said + anyway, then)


def _of_another(case: Case, story: Story) -> GroundedError:
    """Return the error of a log that another candidate of the task ran."""
    other = case.seen.other
    return GroundedError(
        f"{_not_run(case, story.said)} Ingest it with --candidate {other}, with --candidate "
        f"{case.ran} anyway, or with --data for fitting and diagnosis only",
        NextCommand("ingest", (str(case.path), "--candidate", other)),
    )


def _of_earlier(workspace: Folder, path: Path, ran: str) -> GroundedError:
    """Return the error of a log that a candidate of an earlier task ran."""
    was = other_task(workspace.task, workspace.candidate(ran)[0])
    return OfEarlierTask(
        f"{path} ran {ran}, which was made for an earlier task ({was}): its utility can't be "
        "compared. Ingest it with --data for fitting and diagnosis, and run a candidate of this "
        "task; or change the task back, then ingest it",
        NextCommand("ingest", (str(path), "--data")),
    )


def _of_nobody(case: Case, story: Story) -> GroundedError:
    """Return the error of a log that no story explains."""
    ran, why, data = case.ran, story.said, NextCommand("ingest", (str(case.path), "--data"))
    if case.read.bare:
        return GroundedError(
            f"{case.path} says that it ran {ran}, but contains no copy of it, and {why}. If it ran "
            f"the {ran} of another workspace, ingest it there. Ingest it with --data for fitting "
            f"and diagnosis, or with --candidate {ran} anyway",
            data,
        )
    if guessed := sorted(case.guessed):  # the likeliest reason
        differs, _, rather = why.partition("; ")
        why = (
            f"{differs}. Perhaps {listed(guessed)}, which [estimate] finds here, {_is(guessed)} "
            "not what its program used: let it log its own, and map that in [log] too"
            f"{'. Or ' * bool(rather)}{rather}"
        )
    begins = "; set where the run begins with [log.span] start = SECONDS"
    return GroundedError(
        f"{_not_run(case, why)} Ingest it with --data for fitting and diagnosis, or with "
        f"--candidate {ran} anyway{begins * (case.read.log is not None)}",
        data,
    )


def _not_run(case: Case, why: str) -> str:
    """Return that a log did not run its candidate, and what about the log may be why."""
    said = f"{case.path} did not run {case.ran}: {why}{'' if why.endswith('?') else '.'}"
    return said + case.read.hole + (_lasting(case.log, case.task) if case.log else "")


REFUSED: dict[Kind, Callable[[Case, Story], GroundedError]] = {
    Kind.UNIT: _scaled,
    Kind.CANDIDATE: _of_another,
    Kind.EARLIER: lambda case, story: _of_earlier(case.workspace, case.path, story.names[0]),
    Kind.UNKNOWN: _of_nobody,
}


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


def sent_otherwise(workspace: Folder, trial: Trial, names: Sequence[str], by: float) -> str:
    """Return that a program sent inputs times a number, which the log shows as they were sent.

    Another scale in the log would spoil every later one.

    Args:
        workspace: the workspace with the model and the earlier runs, read in the same way.
        trial: the log, as it is read.
        names: signals that have to be multiplied for the candidate's commands.
        by: the number.

    Returns:
        What shows it, a clause; "" if the log may have another unit, or nothing tells.
    """
    from grounded.accounts.judge import contradicted
    from grounded.accounts.table import Account

    model, task, which = workspace.base_model, workspace.task, listed(names)
    if not {*names} <= {*model.input_names}:
        return ""
    if by == -1:
        columns = tuple(model.n + model.input_names.index(name) for name in names)
        fault, known = Account("sign", columns, -1.0), trial.until(trial.known_steps)
        as_logged, mended = (
            contradicted(model, one, range(model.n), fault, constant=False)
            for one in (known, fault.mended(known))
        )
        program = f"so its program sends {which} times -1"
        if as_logged:
            return f"but the robot moved as the log says, {program}"
        if mended or not without(workspace, replace(trial, id=""), fault):
            return ""
        return f"but earlier logs, read in the same way, have the right one, {program}"
    unit = unit_by_factor(model, names, by) or of_full_scale(task, names, by)
    earlier = any(one.candidate for one in workspace.task_trials(measured=True))
    if unit or by in THOUSAND or not earlier:
        return ""
    return (
        f"but its program sends {which} {times_too(by)}: earlier runs, whose logs were read in the "
        "same way, have the right size (if it is the log that changed since, multiply the scale in "
        f"{listed(f'[log.input.{name}]' for name in names)} by {by:.6g})"
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
    known = unit_by_factor(model, names, 1 / by) and not unit_by_factor(model, names, by)
    return bool(known) and turning <= {*names}


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


def of_earlier_task(workspace: Folder, log: Recording | None, trial: Trial) -> Story | None:
    """Return that a candidate of an earlier task sent the commands of a trial, or None.

    Args:
        workspace: the workspace with the candidates.
        log: the foreign log of the trial, in which a run may begin anywhere; else None.
        trial: the trial, with gaps bridged.
    """
    task, void = workspace.task, list[Candidate]()
    for identity in workspace.candidate_ids():
        with suppress(GroundedError):  # a damaged file can't have been run
            candidate, meta = workspace.candidate(identity)
            void += [candidate] * (meta.get("task") != task.hash)
    found = list[Story]()
    for one in reversed(void[-OTHERS:]):
        start = log.start_of(one.policy) if log else None
        fit = None if log else follows(one.policy, trial.until(one.policy.horizon), latest(task))
        error = start.apart if start and start.alike else fit.error if fit and fit.alike else NEAR
        if error < NEAR:
            run = (log.trial_from(start.seconds) if log and start else None) or trial
            found.append(scored(Kind.EARLIER, "", one, run, error, names=(one.id,)))
    return min(found, key=lambda one: one.commands, default=None)


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
