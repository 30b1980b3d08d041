"""Find a candidate's run in a log, and judge by its commands whether it is one."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache, partial
from typing import TYPE_CHECKING

from grounded.findings import Weight, found
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.search.candidate import Candidate
from grounded.search.returned.whose_run import suspicion
from grounded.task import Task
from grounded.trial import interpolate_gaps
from grounded_trials.workspace.intake.locating.fell import fall_in, who_fell
from grounded_trials.workspace.intake.locating.late_start import late_start
from grounded_trials.workspace.intake.locating.missed_steps import not_sent
from grounded_trials.workspace.intake.locating.run_start import Recording, Start
from grounded_trials.workspace.intake.opening.cutting import cut_log
from grounded_trials.workspace.intake.opening.reading import Read
from grounded_trials.workspace.intake.recognising.sender import on_other_speeds, rival_in, sender_of

if TYPE_CHECKING:
    from grounded_trials.workspace.intake.opening.foreign import ForeignLog

ALIGNED = 0.75  # starts closer than this, in sample intervals, are considered equal
PUNCTUAL = 0.1  # of a step: by more, a first command with a stamp of its own is late
STEP_OLD = 0.4  # of a step: commands on older samples may as well be late ones
CLEARLY = 0.7  # a start is elsewhere if its difference is below this share of the first command's


class Look:
    """The search for a candidate's run in a log: where it begins, and whether it is its run.

    Args:
        read: the trial that would be stored.
        log: the log in which its commands are judged; None if `read` was written by grounded.
        own: the candidate.
        candidates: candidates that may have been run instead.
        task: the task of all candidates.
    """

    def __init__(
        self,
        read: Read,
        log: ForeignLog | None,
        own: Candidate,
        candidates: list[Candidate],
        task: Task,
    ) -> None:
        ran, judged = read.trial.candidate, partial(suspicion, task, own=own, others=candidates)
        apart = None if log is read.log else log  # set if judged on other samples than stored
        self.read, self.found, self.exact = read, None, False
        self.old: Array | None = None  # ages of the samples acted on [s], (n,), if it is surely its
        self.whole = interpolate_gaps(apart.cut(ran)[0] if apart else read.trial).trial
        seen = judged(self.whole)
        if read.bare and (alone := judged(self.whole, others=())).why:
            seen = alone  # it may be of another workspace: resembling one of these is coincidence
        self.log = log.recording if log else None
        if log and read.log and self.log:
            start_of = cache(partial(_start_of, self.log))
            self.found = start = start_of(own)
            sender = sender_of(self.log, own, candidates, start_of)
            self.exact = sender.own is not None and sender.own.exact
            if sender.own is not None and sender.sure:
                self.old = sender.own.old
            behind = _behind(self.log, own.policy, start, self.old)
            if behind:
                self.found, self.exact, self.old = behind, True, None
                if abs(behind.seconds - self.log.first) > ALIGNED * self.log.interval:
                    self._cut(read.log, apart, behind, own, task)
                seen = judged(self.whole)
            elif start and elsewhere(self.log, start, own.policy, why=bool(seen.why)):
                self._cut(read.log, apart, start, own, task)
                seen = judged(self.whole)
            if behind or sender.sure:
                seen = replace(seen, why=None, other="")
            elif sender.other:
                seen = replace(seen, why=sender.why, other=sender.other)
            elif (rival := rival_in(self.log, own, candidates, start_of)) is not None:
                best = judged(rival)  # cut where the other candidate fits best
                told = best if best.other else seen if seen.why else replace(seen, why=best.why)
                seen = replace(told, ran=seen.ran)
            guessed = [name for name in self.log.names[0] if name not in self.log.logged]
            doubted = start and guessed and seen.why and not sender.sure
            if start and doubted and on_other_speeds(self.log, own, candidates, start_of):
                if self.read is read:
                    self._cut(read.log, apart, start, own, task)
                seen = replace(judged(self.whole), why=None, other="")
                self.read = self.read.telling(found("log.speeds", *guessed, ran=ran))
        elif log and read.cut and log.spanned and (seen.why or seen.other) and log.anywhere:
            begins = 1e-9 * (read.cut.start_ns - log.anywhere.whole.origin_ns)
            given = Start(begins, 0.0, alike=True, opens_alike=True)
            if sender_of(log.anywhere, own, [], lambda _: given).sure:
                seen = replace(seen, why=None, other="")
        if self.log and seen.why and not seen.other and not (self.found and self.found.opens_alike):
            for at in self.log.openings[:1]:  # told beside the rest before it, any difference grows
                trial = self.log.trial_from(self.log.on_step(own.policy, at))
                there = judged(trial) if trial else None
                if there and there.ran and seen.ran and there.ran.rms < seen.ran.rms:
                    seen = replace(seen, why=there.why) if there.why and not there.other else seen
        asked = read.log and not seen.other
        self.fell = fall_in(task, own, self.read.trial, seen.ran) if asked else None
        if self.fell and self.log:
            first, steps = self.found.seconds if self.found else self.log.first, self.fell[0]
            if name := who_fell(self.log, own, candidates, start_of, first + steps * task.dt):
                self.fell, seen = (
                    None,
                    replace(seen, other=name, why=found("log.another", ran=ran, other=name)),
                )
        self.suspicion = seen

    def _cut(
        self, log: ForeignLog, apart: ForeignLog | None, start: Start, own: Candidate, task: Task
    ) -> None:
        """Cut the run from a log where it begins."""
        ran, begins = own.id, start.seconds + (_sooner(apart, log) if apart else 0)
        kept = [one for one in self.read.findings if one.weight is Weight.NOTE]
        cut_there = replace(cut_log(log, ran, begins), before=self.read.before)
        self.read = cut_there.telling(*kept)
        if start.missed:
            self.read = self.read.telling(not_sent(task, ran, start.missed))
        elif begins > 0:
            self.read = self.read.telling(found("log.earlier_rows", ran=ran, seconds=begins))
        cut = apart.cut(ran, start.seconds)[0] if apart else self.read.trial
        self.whole = interpolate_gaps(cut).trial

    @property
    def doubt(self) -> tuple[bool, float]:
        """Whether it is another's run, and how far the commands are from the candidate's."""
        ran = self.suspicion.ran
        return bool(self.suspicion.why), math.inf if ran is None else ran.error


def _start_of(log: Recording, candidate: Candidate) -> Start | None:
    """Return where a candidate's run seems to begin in a log."""
    return log.start_of(candidate.policy)


def _behind(log: Recording, policy: Policy, found: Start | None, old: Array | None) -> Start | None:
    """Return where a run begins whose commands are some steps late, or None.

    The same commands are exact a step later, too, on samples that were a step old; but there the
    program had sent something before its first step.

    Args:
        log: the log.
        policy: the candidate's.
        found: the start that fits best with commands in time.
        old: ages of the samples [s] with which the commands are exact there; None if they are not.
    """
    if old is not None and not (old.size and old.max() > STEP_OLD * log.dt):
        return None
    late = late_start(log, policy, found)
    if late is None or old is None or found is None:
        return late
    near = ALIGNED * log.interval
    here, there = (
        any(abs(at - one.seconds) < near for at in log.openings) for one in (late, found)
    )
    return late if here and not there else None


def _sooner(log: ForeignLog, stored: ForeignLog) -> float:
    """Return by how much the first sample of the stored log is earlier [s]."""
    assert log.recording is not None and stored.recording is not None
    return (log.recording.whole.origin_ns - stored.recording.whole.origin_ns) * 1e-9


def elsewhere(log: Recording, start: Start, policy: Policy, *, why: bool) -> bool:
    """Return whether a run begins at the start found rather than at the log's first command.

    The first command of a busy computer may be late. If the run began with it, all others would be
    early, and would be compared with states that the program did not have yet.
    """
    if start.missed or (start.between_rows and start.alike):
        return True
    off = abs(start.seconds - log.first)
    if not start.opens_alike or off <= ALIGNED * log.interval:
        return start.alike and off > PUNCTUAL * log.dt and not log.late.any()
    return why or start.exact or start.apart < CLEARLY * log.apart_at(policy, log.first)
