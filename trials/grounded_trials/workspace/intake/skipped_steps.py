"""Tell of a program that ran only some steps of its candidate: its loop is slower than dt.

A policy's plan, gains and reference change from step to step, so its commands change even if no new
states arrive. Where they stay the same to the last digit all the same, the step was not run. A loop
at half the rate runs every other step and holds each command twice as long.
"""

from __future__ import annotations

import numpy as np

from grounded.search.returned.who_drove import LEAST
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.workspace.folder import Folder

CHANGES = 2e-3  # smallest change of a command by its step alone, relative to its size, that tells
MOST = 0.3  # share of the steps that tell which may be lost in a run


def steps_skipped(workspace: Folder, trial: Trial) -> str:
    """Return the warning for a run in which many steps were not run; or "".

    Args:
        workspace: the workspace with the task and the candidate.
        trial: the trial as stored.
    """
    if not (ran := trial.candidate):
        return ""
    trial, task = interpolate_gaps(trial).trial, workspace.task
    policy = workspace.candidate(ran)[0].policy
    T = min(trial.finite_steps, policy.horizon)
    if T < LEAST:
        return ""
    sent = np.clip(trial.inputs[:T], policy.low, policy.high)
    past = policy.past if trial.start_inputs is None else trial.start_inputs
    before = policy.commands(trial.states[None, :T], past, sent[None])[0][:-1]
    shifted = trial.states[None, np.r_[0, : T - 1]]  # no new states since the step before
    after = policy.commands(shifted, past, sent[None])[0][1:]
    size = np.maximum(np.abs(policy.feedforward).max(axis=0), np.abs(sent).max(axis=0)) + 1e-12
    moved = np.abs(np.diff(sent, axis=0))
    finest = np.where(moved > 0, moved, size).min(axis=0)  # to which the log is rounded
    tells = (np.abs(after - before) > np.maximum(CHANGES * size, finest)).any(axis=1)
    changed = np.flatnonzero(moved.any(axis=1))
    held = tells & ~moved.any(axis=1)
    if min(tells.sum(), len(changed)) < LEAST or held.sum() < MOST * tells.sum():
        return ""
    every = float(np.median(np.diff(changed)))
    if every < 2:
        return ""
    ms, dt, lost = 1e3 * every * task.dt, 1e3 * task.dt, 100 - 100 / every
    return (
        f"its commands change every {ms:.3g} ms, dt is {dt:.3g} ms: {lost:.0f} % of "
        f"the steps of {ran} were not run, or not logged. Call the runner every {dt:.3g} ms and "
        f"log every command, and run {ran} again; if the robot can't, set [task] dt = "
        f"{every * task.dt:.3g}"
    )
