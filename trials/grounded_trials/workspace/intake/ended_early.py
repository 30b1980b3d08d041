"""Say of a run that ended early whether it crashed, or rather its recording or the run was cut.

A log does not tell whether the robot crashed at its end, somebody stopped it, or only the recording
ended. But a robot that crashes leaves its prediction or [safety] first. If it was as near to its
prediction at the end as before, and was not about to leave [safety], the candidate should not count
as failed: the next plan would shrink from it.
"""

from __future__ import annotations

import numpy as np

from grounded.search.candidate import Candidate
from grounded.search.returned.as_predicted import like_predicted
from grounded.search.returned.who_drove import LEAST
from grounded.task import Task
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.gone_wrong import Asked

NEAR = 0.05  # of a state's range in the prediction: a smaller distance from it is no crash
GROWN = 1.5  # times as far from the prediction at the end as before: farther off is no usual end


def ended_early(workspace: Folder, trial: Trial) -> Asked | None:
    """Return what a run that ended early counts as, and what to do; None if it did not.

    Args:
        workspace: the workspace with the task and the candidates.
        trial: the trial as stored.
    """
    task, run = workspace.task, interpolate_gaps(trial).trial
    if not run.candidate or run.steps >= task.horizon or run.whole(task.horizon) is not run:
        return None
    own, _ = workspace.candidate(run.candidate)
    name, ends = own.id, f"after {run.steps} of {task.horizon} steps ({run.steps * run.dt:.2f} s)"
    complete = _complete(workspace, run)
    before = f"{name} ran to the end before ({complete}). " if complete else ""
    if as_before(task, own, run):
        return Asked(
            f"the log ends {ends}, with the robot as near to its prediction as until then. {before}"
            f"Was the recording cut off, or the robot stopped? Then `discard {run.id}`, run {name} "
            f"again and record it to its end. If it crashed there, `propose` goes on: {name} "
            "counts as failed"
        )
    return Asked(
        f"the run ended {ends}: a failed candidate; its data stay usable for fit and diagnose. "
        f"{before}Use `discard {run.id}` if you stopped it for another reason, or if only the "
        "recording was cut off",
        aside=False,
    )


def as_before(task: Task, own: Candidate, run: Trial) -> bool:
    """Return whether a run was as near to its prediction at its end as before, inside [safety].

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
    soon = 2 * run.states[-1] - run.states[-1 - LEAST]  # as many steps later, at the same rate
    assert task.safety_low is not None and task.safety_high is not None
    inside = [((x >= task.safety_low) & (x <= task.safety_high)).all() for x in run.states]
    inside.append(((soon >= task.safety_low) & (soon <= task.safety_high)).all())
    return bool(all(inside) and (off[-LEAST:] <= known).all())


def _complete(workspace: Folder, run: Trial) -> str:
    """Return the runs of the same candidate that were complete, as text."""
    horizon = workspace.task.horizon
    return ", ".join(
        one.id
        for one in workspace.task_trials()
        if one.candidate == run.candidate and one.whole(horizon).finite_steps >= horizon
    )
