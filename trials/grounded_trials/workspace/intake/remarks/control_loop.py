"""Tell how the robot's program ran its candidate otherwise than planned, such as late.

Commands that are some steps late in a log were sent late or logged late: commands and states alone
do not tell which.
"""

from __future__ import annotations

from grounded.accounts.returned import Kind, stories
from grounded.accounts.sent import LATEST, UNLIKE, as_sent, follows, latest
from grounded.findings import Finding, found
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.workspace.folder import Folder

SAME = 0.4  # relative difference of two ages or lags that are one


def ran_otherwise(workspace: Folder, trial: Trial) -> Finding | None:
    """Return how a program ran its candidate otherwise than planned; None if it did not.

    Args:
        workspace: the workspace with the task and the candidate.
        trial: the trial as stored.
    """
    if not trial.candidate:
        return None
    task, (own, _) = workspace.task, workspace.candidate(trial.candidate)
    run = interpolate_gaps(trial).trial.until(task.horizon)
    if as_sent(own.policy, run):
        return None
    ran = follows(own.policy, run, max(LATEST, latest(task)))
    some = stories(task, own, run, ran)
    if some and some[0].kind is Kind.PROGRAM:
        return some[0].finding
    if ran is None or not (ran.alike and ran.late and ran.moved < UNLIKE):
        return None
    # the states acted on show a wrong start
    late, side = ran.late, "late" if ran.late > 0 else "early"
    start = late < 0 or ran.age <= (1 - SAME) * late
    what = "start" if start else "either"
    return found("log.late", ran=own.id, steps=abs(late), side=side, what=what)
