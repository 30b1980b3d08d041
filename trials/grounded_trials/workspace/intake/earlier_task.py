"""Whether a log ran a candidate of an earlier task: one that was left on the robot.

The candidates that a log is compared with are those of the task as it is. After its target, reward
or start was changed the others are void, and still the likeliest to have been run by mistake.
"""

from __future__ import annotations

from contextlib import suppress

from grounded.errors import GroundedError
from grounded.trial import Trial
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.run_start import Recording
from grounded_trials.workspace.intake.who_drove import OTHERS, follows, latest

NEAR = 0.05  # of an input's size: the mean difference of a run from its policy's commands


class OfEarlierTask(GroundedError):
    """A log that ran a candidate which the task has left behind."""


def of_earlier_task(workspace: Folder, log: Recording | None, trial: Trial) -> str:
    """The candidate of an earlier task whose commands a trial has; "" where there is none.

    Args:
        workspace: whose candidates they are.
        log: the foreign log that the trial is from, in which a run may begin anywhere; else None.
        trial: with gaps bridged.
    """
    least, name, task = NEAR, "", workspace.task
    void = []
    for identity in workspace.candidate_ids():
        with suppress(GroundedError):  # a damaged file was not run now
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
