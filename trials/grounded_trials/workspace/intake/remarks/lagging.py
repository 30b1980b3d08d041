"""Tell that a run's commands are some steps off: sent late, logged late, or its start set wrongly.

A run whose program passed `runner.action` the state and the seconds of a step before sent what was
due then: that run says little about its candidate. If only the log has the commands late, the run
counts. By the commands alone the two are one; `what_is_late` asks the robot's motion.
"""

from __future__ import annotations

from dataclasses import dataclass

from grounded.search.candidate import Candidate
from grounded.search.feedback.sample_age import sample_age
from grounded.search.returned.late_commands import Late, what_is_late
from grounded.search.returned.who_drove import UNLIKE, follows, latest
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.wording import count, ranges
from grounded_trials.workspace.folder import Folder

LATEST = 3  # largest number of steps by which late commands are reported
EARLIER = 3  # latest runs in time whose motion is compared
NOW = 0.5  # part of the lag up to which the age of the states acted on shows a wrong start


@dataclass(frozen=True)
class Lagging:
    """Commands of a run that are not at their steps.

    Args:
        ran: the candidate.
        steps: by which they are late; negative if early.
        what: what is late; None if the run begins elsewhere, or if its commands are early.
        dt: step [s].
        earlier: earlier runs, whose commands were in time.
    """

    ran: str
    steps: int
    what: Late | None
    dt: float
    earlier: tuple[str, ...] = ()

    @property
    def again(self) -> bool:
        """Whether the candidate is to be run again: its program sent its commands late."""
        return self.what is Late.PROGRAM

    def told(self) -> str:
        """Return what is late and the remedy."""
        name, by, side = self.ran, count(abs(self.steps), "step"), "late" * (self.steps > 0)
        lag = f"{by} ({1e3 * abs(self.steps) * self.dt:.3g} ms) {side or 'early'}"
        start = f"[log.span] start is {by} too {'early' if side else 'late'}"
        passed = (
            "pass `runner.action` the latest states and the seconds since the run began, and send "
            "what it returns at once"
        )
        if self.what is Late.PROGRAM:
            return (
                f"its program sent the commands of {name} {lag}: the robot moved with the commands "
                f"as they are in the log, as in {ranges(self.earlier)}, so the log is right. Let "
                f"it {passed}; discard this run and run {name} again"
            )
        if self.what is Late.EITHER:
            return (
                f"its commands are those of {name} {lag}: its program sent them late, or the log "
                f"has them late. Let it {passed}; if it does, log each command at the time it is "
                f"sent; if that is so, too, {start}"
            )
        if self.what is Late.LOG:
            return (
                f"its commands are logged {lag}: the robot moved by them before. Log each command "
                f"at the time it is sent; if it is, {start}"
            )
        return (
            f"its commands fit {name} better when shifted by {by}: {start}, or they are logged "
            f"{lag}"
        )


def lagging(workspace: Folder, trial: Trial) -> Lagging | None:
    """Return by how many steps the commands of a run are off, and what is; None if they are not.

    Args:
        workspace: the workspace with the candidates and the earlier runs.
        trial: as stored; None is returned for one that ran no candidate.
    """
    if not trial.candidate:
        return None
    trial = interpolate_gaps(trial).trial
    task, (own, _) = workspace.task, workspace.candidate(trial.candidate)
    whole = trial.until(task.horizon)
    ran = follows(own.policy, whole, max(LATEST, latest(task)))
    if ran is None or not ran.alike:
        return None
    if not ran.late:
        return _logged_late(workspace, own, whole)
    if not ran.moved < UNLIKE:
        return None
    if ran.late < 0 or ran.age <= NOW * ran.late:
        return Lagging(own.id, ran.late, None, task.dt)
    before = _in_time(workspace, trial.id)
    what = what_is_late(workspace.planner, whole, ran.late, before)
    if own.policy.gain is None and what is Late.PROGRAM:  # nor does the start show in its commands
        what = Late.EITHER
    return Lagging(own.id, ran.late, what, task.dt, tuple(one.id for one in before))


def _logged_late(workspace: Folder, own: Candidate, run: Trial) -> Lagging | None:
    """Return that a run whose samples seem to be steps old rather has its commands logged late.

    Cut where its commands begin in the log, it is the same.
    """
    steps = round(sample_age(workspace.task, own, [run]) / workspace.task.dt)
    if steps < 1:
        return None
    before = _in_time(workspace, run.id)
    if what_is_late(workspace.planner, run, steps, before) is not Late.LOG:
        return None
    return Lagging(own.id, steps, Late.LOG, workspace.task.dt, tuple(one.id for one in before))


def _in_time(workspace: Folder, but: str) -> list[Trial]:
    """Return the latest other runs whose commands were in time."""
    found, task = list[Trial](), workspace.task
    for one in reversed(workspace.task_trials()):
        if len(found) == EARLIER:
            break
        if one.candidate and "~" not in one.candidate and one.id != but:
            run = one.until(task.horizon)
            ran = follows(workspace.candidate(one.candidate)[0].policy, run, latest(task))
            if ran is not None and ran.alike and not ran.late:
                found.append(run)
    return found[::-1]
