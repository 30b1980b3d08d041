"""Detect logs of a candidate of an earlier task that was left on the robot.

A log is normally compared with the candidates of the current task. After the target, reward or
start was changed, the earlier candidates are void but likely to have been run by mistake.
"""

from __future__ import annotations

from contextlib import suppress

from grounded.errors import GroundedError
from grounded.search.returned.who_drove import OTHERS, follows, latest
from grounded.trial import Trial
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.run_start import Recording

NEAR = 0.05  # largest mean difference from the policy's commands, relative to an input's size


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
