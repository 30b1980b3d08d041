"""Tell how the robot's program ran its candidate: late, cut, on old samples, smoothed or swinging.

A policy's plan, gains and reference change from step to step, so its commands change even if no new
states arrive. Where they stay the same to the last digit all the same, the step was not run. A loop
at half the rate runs every other step and holds each command twice as long.

Commands that are some steps late in a log were sent late or logged late: commands and states alone
do not tell which.
"""

from __future__ import annotations

import numpy as np

from grounded.accounts.sent import (
    LATEST,
    RESEMBLES,
    STEPS_TO_JUDGE,
    UNLIKE,
    as_sent,
    commanded,
    follows,
    latest,
)
from grounded.findings import Finding, found
from grounded.frozen import Array
from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.workspace.folder import Folder

CHANGES = 2e-3  # smallest change of a command by its step alone, relative to its size, that tells
UNSENT = 5  # steps without a command that are fewer are sought where the run begins
LOST = 0.3  # share of the steps that tell which may be lost in a run
SAME = 0.4  # relative difference of two ages or lags that are one


def ran_otherwise(workspace: Folder, trial: Trial) -> Finding | None:
    """Return how a program ran its candidate otherwise than planned; None if it did not.

    Args:
        workspace: the workspace with the task and the candidate.
        trial: the trial as stored.
    """
    if not trial.candidate:
        return None
    own, whole = workspace.candidate(trial.candidate)[0], interpolate_gaps(trial).trial
    if as_sent(own.policy, whole):
        return None
    from grounded.accounts.returned import Kind, stories

    if one := steps_skipped(workspace.task, own, whole):
        return one
    run = whole.until(workspace.task.horizon)
    ran = follows(own.policy, run, max(LATEST, latest(workspace.task)))
    some = stories(workspace.task, own, run, ran)
    if some and some[0].kind is Kind.PROGRAM:
        return some[0].finding
    if ran is None or not (ran.alike and ran.late and ran.moved < UNLIKE):
        return None
    # the states acted on show a wrong start
    late, side = ran.late, "late" if ran.late > 0 else "early"
    start = late < 0 or ran.age <= (1 - SAME) * late
    what = "start" if start else "either"
    return found("log.late", ran=own.id, steps=abs(late), side=side, what=what)


def steps_skipped(task: Task, own: Candidate, trial: Trial) -> Finding | None:
    """Return that many steps of a run, or the first ones, were not run; or None.

    Args:
        task: the manoeuvre.
        own: the candidate.
        trial: its run, without gaps.
    """
    policy = own.policy
    T = min(trial.finite_steps, policy.horizon)
    if T < STEPS_TO_JUDGE:
        return None
    run = commanded(policy, trial)
    sent, asked, past, size = run.sent, run.asked, run.past, run.size
    if unsent := _unsent(np.abs(asked - sent) / size, np.abs(sent - past) / size):
        return found("run.unsent", ran=own.id, steps=unsent)
    shifted = trial.states[None, np.r_[0, : T - 1]]  # no new states since the step before
    after = policy.commands(shifted, past, sent[None])[0][1:]
    moved = np.abs(np.diff(sent, axis=0))
    finest = np.where(moved > 0, moved, size).min(axis=0)  # to which the log is rounded
    tells = (np.abs(after - asked[:-1]) > np.maximum(CHANGES * size, finest)).any(axis=1)
    changed = np.flatnonzero(moved.any(axis=1))
    held = tells & ~moved.any(axis=1)
    if min(tells.sum(), len(changed)) < STEPS_TO_JUDGE or held.sum() < LOST * tells.sum():
        return None
    every = float(np.median(np.diff(changed)))
    if every < 2:
        return None
    every, dt = 1e3 * every * task.dt, 1e3 * task.dt
    return found("run.skipped", ran=own.id, lost=1 - dt / every, every=every, dt=dt)


def _unsent(off: Array, held: Array) -> int:
    """Return how many steps of a run passed before its program sent anything; 0 for few or none.

    Args:
        off: (T, m) differences of the commands from the policy's, relative to their size.
        held: (T, m) differences from what was held before the run.
    """
    begins = int(np.argmax((held > CHANGES).any(axis=1)))
    if not UNSENT < begins < len(off) - STEPS_TO_JUDGE:
        return 0
    lacking, sent = (
        float(np.median(off[part].max(axis=1))) for part in (slice(begins), slice(begins, None))
    )
    return begins if lacking > RESEMBLES and sent < UNLIKE * lacking else 0
