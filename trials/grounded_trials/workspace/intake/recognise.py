"""Refuse a log whose commands are not those of its candidate, and say what it is instead.

A log may be the run of another candidate, of one of an earlier task that was left on the robot, or
of its own one read in another unit, at another rate or from exchanged columns; or the robot's
program passed its candidate the wrong things. Each is a story with a score; the likeliest is
told, with its remedy. A user who names the candidate gets a warning instead.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, cached_property
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from grounded.accounts.levels import FINE
from grounded.accounts.reported import scaled as scaled_columns
from grounded.accounts.returned import (
    OTHERS,
    Kind,
    Story,
    likeliest,
    scored,
    stories,
    suspicion,
    unit_by_factor,
)
from grounded.accounts.sent import Fed, Ran, follows, latest
from grounded.accounts.table import Account
from grounded.checks import refused
from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding, Quantity, Weight, found
from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.logs.log_table import misread
from grounded_trials.workspace.candidates.search_state import latest_candidates
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import other_task, sha256
from grounded_trials.workspace.intake.log_faults import column_faults, not_the_logs
from grounded_trials.workspace.intake.look import elsewhere, fall_in
from grounded_trials.workspace.intake.opening.foreign import cut_log, cut_short
from grounded_trials.workspace.intake.opening.reading import Read
from grounded_trials.workspace.intake.opening.run_start import TRIED, Recording, Start

if TYPE_CHECKING:
    from grounded_trials.workspace.intake.opening.foreign import ForeignLog

WHOLE = 0.9  # share of a run that a log must last to be one, or else the error says so
SHORTER = 1.0  # [nats] that a fall costs


class Case:
    """A log that should be the run of a candidate, and all that stories of it are made from.

    `log` is that in which its commands are judged; None if `read` was written by grounded.
    """

    def __init__(self, workspace: Folder, path: Path, read: Read, log: ForeignLog | None) -> None:
        self.workspace, self.path, self.task = workspace, path, workspace.task
        self.read, self.ran = read, read.trial.candidate
        self.own, _ = workspace.candidate(self.ran)
        # what may still be on the robot: of earlier tasks with as many steps as a run of this one
        candidates, earlier = latest_candidates(workspace, OTHERS)
        shape = attrgetter("dt", "horizon", "state_names", "input_names")
        self.earlier = [one for one in earlier if shape(one.policy) == shape(self.own.policy)]
        self.rivals = [*self.earlier, *candidates]
        self.found: Start | None = None
        # set if judged on other samples than stored
        self.apart = None if log is read.log else log
        cut = self.apart.cut(self.ran)[0] if self.apart else read.trial
        self.whole = interpolate_gaps(cut).trial
        self.log = log.recording if log else None
        self.guessed = {*self.log.names[0]} - {*self.log.measured} if self.log else set[str]()
        # the samples that were acted on, and where the run begins in them
        self.samples, self.begins = self.log or (log.anywhere if log else None), 0.0
        if self.log and read.log:
            self.begins = self._located(self.log, read.log)
        elif self.samples and read.cut:
            self.begins = 1e-9 * (read.cut.start_ns - self.samples.whole.origin_ns)
        logged = self.log.measured if self.log else None
        self.seen = suspicion(self.task, self.whole, self.own, self.rivals, logged, self.given)
        judged = read.log is not None and not self.seen.other
        fell = fall_in(self.task, self.own, self.read.trial, self.seen.ran) if judged else None
        self.fell = fell
        self.rival = next((one for one in self.rivals if one.id == self.seen.other), None)
        self.again = NextCommand("ingest", (str(path) if read.log else "LOG",))

    @cached_property
    def start_of(self) -> Callable[[Any], Start | None]:
        """Where a candidate's run seems to begin in the log, if anywhere."""
        log = self.log
        return cache(lambda one: log.start_of(one.policy) if log else None)

    def given(self, one: Ran) -> Iterator[tuple[Trial, Fed | None]]:
        """Yield the run if it is a candidate's, and what that may have been fed in it."""
        log, run, begins = self.samples, self.whole, {self.begins}
        if log is None:
            yield run, None
            return
        yield run, log.fed(one.policy, self.begins, run.until(self.task.horizon))
        if one.id != self.own.id and self.log:  # its run may begin otherwise
            if fit := follows(one.policy, run.until(self.task.horizon), latest(self.task)):
                begins.add(self.begins + fit.late * self.task.dt)
            if not (self.found and self.found.alike) and (begun := self.start_of(one)):
                begins |= {begun.seconds} if begun.opens_alike else set()
            for at in begins - {self.begins}:
                if other := log.trial_from(at):
                    yield other, log.fed(one.policy, at, other.until(self.task.horizon))

    def _located(self, log: Recording, stored: ForeignLog) -> float:
        """Cut the run where it begins in the log; return when that is [s]."""
        self.found = start = self.start_of(self.own)
        if start is None or not elsewhere(log, start, self.own.policy):
            return log.first
        self._cut(stored, start)
        return start.seconds

    def _cut(self, stored: ForeignLog, start: Start) -> None:
        """Cut the run from a log where it begins; of another log, from its samples too."""
        begins, kept = (
            start.seconds,
            [one for one in self.read.findings if one.weight is Weight.NOTE],
        )
        if self.apart and self.log and stored.recording:
            begins += (self.log.whole.origin_ns - stored.recording.whole.origin_ns) * 1e-9
        self.read = cut_log(stored, self.ran, begins).telling(*kept)
        cut = self.apart.cut(self.ran, start.seconds)[0] if self.apart else self.read.trial
        self.whole = interpolate_gaps(cut).trial

    @property
    def doubt(self) -> tuple[bool, float]:
        """Whether it is another's run, and how far the commands are from the candidate's."""
        return bool(self.seen.why), self.seen.ran.error if self.seen.ran else math.inf

    @property
    def opens(self) -> bool:
        """Whether at least the first commands are the candidate's, from the start found on."""
        return bool(self.found and self.found.opens_alike)

    @cached_property
    def as_logged(self) -> Story:
        """The story of a log that is as it should be: of the rival by evidence, or of nobody."""
        rival, why = self.rival, self.seen.why
        if rival is None:
            error = self.seen.ran.error if self.seen.ran else 1.0
            return scored(Kind.UNKNOWN, why, self.own, self.whole, error)
        kind = Kind.EARLIER if rival in self.earlier else Kind.CANDIDATE
        return Story(kind, why, names=(rival.id,))

    @cached_property
    def columns(self) -> list[Finding]:
        """The faults of columns; none of them can be told without the commands."""
        trial, fell = replace(self.read.trial, id=""), self.fell
        known = trial.until(min(trial.known_steps, fell[0] if fell else trial.steps))
        return [] if self.silent else column_faults(self.workspace, known)

    @property
    def silent(self) -> bool:
        """Whether commands are 0 throughout, though the plan moves them."""
        return self.seen.why is not None and self.seen.why.code == "log.silent"


def recognised(workspace: Folder, path: Path, read: Read, candidate: str | None) -> Read:
    """Refuse a log whose commands are not its candidate's; only warn if the user named a candidate.

    A foreign log without a [log.span] may begin before the run: it is cut where the run begins.

    Raises:
        GroundedError: if it is not a run of its candidate, with what it is instead if known.
    """
    ran = read.trial.candidate
    if not ran or (
        workspace.store.holds(sha256(read.data)) and not (read.log and not read.log.stored)
    ):
        return read  # a log whose trial is set aside is examined again
    logs = [read.log]
    if read.log and (late := read.log.as_seen):  # its program may have acted on these samples
        logs.append(late)
    cases = [Case(workspace, path, read, log) for log in logs]
    case = min(cases, key=lambda one: one.doubt)
    read, fell = case.read, case.fell
    if read.cut and read.cut.late_s > case.task.dt / 2:  # a state is not known when it begins
        after = Quantity(read.cut.late_s, "s")
        raise refused("log.late_states", where=str(path), late=after)
    stored = read.log.stored if read.log else ()
    if accepted := [one.trial.steps for one in stored if one.trial.candidate == ran]:
        return cut_short(read, fell[0]) if fell and fell[0] in accepted else read
    story = case.as_logged
    if case.rival is None:
        kinds = (Kind.UNIT, Kind.LOG) if case.log else (Kind.UNIT,)
        story = likeliest((one for one in case.seen.stories if one.kind in kinds), story)
        if not case.seen.why and story.kind is Kind.UNKNOWN:
            return cut_short(read, *fell) if fell else read
        story = likeliest([story, *_of_log(case)], case.as_logged)
    if story.kind is Kind.UNKNOWN:  # it says nothing of how the robot moved
        story = next(_of_columns(case, case.columns), story)
    if story.kind is Kind.FELL and fell:
        return cut_short(read, *fell)
    story = _where(case, story)
    if candidate is not None:
        return _doubted(case, read, story)
    raise _refusal(case, story)


def _of_log(case: Case) -> Iterator[Story]:
    """Yield the stories of a log whose commands are not its candidate's."""
    log, task, own, fell = case.log, case.task, case.own, case.fell
    if fell and case.seen.ran:
        error = np.nanmean((case.seen.ran.off / case.seen.ran.fine)[: fell[0]] ** 2) ** 0.5
        part = case.whole.until(fell[0])
        yield scored(Kind.FELL, fell[1], own, part, FINE * float(error), price=SHORTER)
    if log:
        yield from stories_of_log(log, task, own, case.found)
    if dead := [one for one in case.columns if one.code == "log.dead"]:
        yield replace(next(_of_columns(case, dead)), commands=-np.inf)


def stories_of_log(log: Recording, task: Task, own: Candidate, start: Start | None) -> list[Story]:
    """Return the stories of a log that explain its commands as its candidate's.

    The commands don't tell where its run begins: so the table is asked at the start found, at the
    first command, and at the instants at which commands begin to change.
    """
    at = [*([start.seconds] if start else []), log.first, *log.openings[:TRIED]]
    how: dict[str, Any] = {"logged": log.measured, "waits": log.waits}
    some = list[Story]()
    for begins in dict.fromkeys(log.on_step(own.policy, one) for one in at):
        if trial := log.trial_from(begins):
            run = trial.until(min(trial.finite_steps, task.horizon))
            some += stories(task, own, run, follows(own.policy, run, latest(task)), **how)
    return some


def _of_columns(case: Case, odd: Sequence[Finding]) -> Iterator[Story]:
    """Yield the faults of columns that motion and kinematics show."""
    log = case.read.log
    names = misread(case.task.model, log.mapping) if log else []
    if every := [*names, *odd]:
        yield Story(Kind.LOG, every[0], commands=-np.inf)


def _doubted(case: Case, read: Read, story: Story) -> Read:
    """Return the run of a candidate that the user named, with what is doubtful about it."""
    log = case.log
    by_hand = log and not (case.opens or case.rival or case.silent)
    nobody = by_hand and case.seen.ran and not case.seen.ran.opens
    nobody = nobody and story.kind in (Kind.UNKNOWN, Kind.LOG)
    aside = story.kind is Kind.PROGRAM or nobody
    assert story.finding is not None
    doubts = [story.finding.weighing(Weight.ASIDE if aside else Weight.WARN)]
    if log and not case.opens:
        doubts.append(found("log.start_assumed", ran=case.ran, at=log.first))
    return replace(read.telling(*doubts), doubted=True)


def _where(case: Case, story: Story) -> Story:
    """Return a story of columns with where its fault lies: in the log, or on the robot."""
    model, names, facts = case.task.model, story.names, dict[str, Any](ran=case.ran)
    every = (*model.state_names, *model.input_names)
    columns = tuple(every.index(name) for name in names if name in every)
    trial, sent = replace(case.whole, id=""), {*names} <= {*model.input_names}
    if story.kind is Kind.UNIT:
        names = tuple(name for name in names if name not in case.guessed)
        fault = Account("sign", columns, -1.0)
        if (
            story.by == -1
            and sent
            and (shown := not_the_logs(case.workspace, trial, fault, commands=True))
        ):
            told = found("run.sends", *names, times=-1).also(**facts, **shown)
            return replace(story, kind=Kind.LOG, finding=told, rerun=True)
        unit = unit_by_factor(model, names, story.by)
        told = scaled_columns(model, names, 1 / story.by, unit).also(**facts)
        if case.read.log is None:  # a program that writes trials
            units = {**model.states, **model.inputs}
            told = told.also(tables=(), writes=tuple(dict.fromkeys(units[name] for name in names)))
        return replace(story, finding=told)
    if story.finding and story.finding.code == "log.exchange" and len(columns) == 2:
        fault = Account("exchange", pairs=((columns[0], columns[1]),))
        if shown := not_the_logs(case.workspace, trial, fault, commands=True):
            parts = "outputs" if sent else "states"
            told = found("run.exchanged", *names, parts=parts, **(facts | shown))
            return replace(story, finding=told, rerun=True)
    return story


def _refusal(case: Case, story: Story) -> GroundedError:
    """Return the error of a log that is no run of its candidate as it is, and the next command."""
    path, kind, told = str(case.path), story.kind, story.finding
    data, then = NextCommand("ingest", (path, "--data")), case.again
    assert told is not None
    if kind is Kind.EARLIER:
        return _of_earlier(case.workspace, path, story.names[0])
    if kind is Kind.PROGRAM or story.rerun:
        then = NextCommand("next", ("LOG",))
    elif kind is Kind.CANDIDATE and case.read.log:
        then = NextCommand("ingest", (path, "--candidate", case.seen.other))
    elif kind in (Kind.UNKNOWN, Kind.CANDIDATE):
        then, told = data, told.also(guessed=tuple(sorted(case.guessed)))
        if case.log and 0 < _lasting_s(case.log) < WHOLE * case.task.horizon * case.task.dt:
            told = told.also(lasts=Quantity(_lasting_s(case.log), "s"))
    return GroundedError(told.also(where=path).weighing(Weight.REFUSE), then)


def _lasting_s(log: Recording) -> float:
    """Return how long a log lasts after its first command [s]."""
    end = min(int(one.t.max()) for one in log.logged.values())
    return 1e-9 * (end - log.whole.origin_ns) - log.first


def _of_earlier(workspace: Folder, path: str, ran: str) -> GroundedError:
    """Return the error of a log that a candidate of an earlier task ran."""
    was = other_task(workspace.task, workspace.candidate(ran)[0])
    told = found("log.earlier", path, ran=ran, was=was)
    return GroundedError(told, NextCommand("ingest", (path, "--data")))
