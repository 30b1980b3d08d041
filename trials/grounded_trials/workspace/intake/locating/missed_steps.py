"""Detect runs whose first steps were never sent, so that they begin before the first command.

A program whose timer fires late skips step 0, as the runner does for missed calls, and the first
command in the log is that of step 1. If it is taken as step 0, every command is compared with the
gains and reference of its neighbour, and may still look alike if those change little from step to
step. So starts some steps earlier are tried as well, with the input held before the run in place of
the missing commands, and the commands that were sent are compared with the policy's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from grounded.accounts.sent import LEAST, UNLIKE, commanded, follows
from grounded.findings import Finding, found
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.wording import with_unit
from grounded_trials.workspace.intake.locating.acted_on import acted_on

if TYPE_CHECKING:
    from grounded_trials.workspace.intake.locating.run_start import Recording

MOST = 5  # largest number of missed steps that is tried


def missed_steps(log: Recording, policy: Policy, first: float, otherwise: float) -> int:
    """Return how many steps of a policy's run lie before the log's first command; 0 if unclear.

    Args:
        log: the log with the run.
        policy: the policy, for the states and inputs of the log.
        first: the time of the first command, moved to where a step begins [s].
        otherwise: where the run seems to begin if none were missed [s].
    """
    usual = acted_on(log, policy, otherwise)
    if usual is not None and usual.exact:
        return 0
    k = min(range(1, MOST + 1), key=lambda k: _left(log, policy, first, k))
    if not np.isfinite(_left(log, policy, first, k)):
        return 0
    begins = first - k * log.dt
    there, trial = acted_on(log, policy, begins), log.trial_from(begins)
    if there is None or trial is None or there.told.sum() < LEAST:
        return 0
    if there.exact:
        return k
    ran = follows(policy, trial.until(policy.horizon), 0)
    alike = ran is not None and ran.alike and not ran.late
    return k if alike and usual is not None and there.left < UNLIKE * usual.left else 0


def _left(log: Recording, policy: Policy, first: float, missed: int) -> float:
    """Return the median difference of the sent commands from the policy's, in units of size."""
    trial = log.trial_from(first - missed * log.dt)
    T = 0 if trial is None else min(trial.finite_steps, policy.horizon)
    if trial is None or T - missed < LEAST:
        return np.inf
    return float(np.median(_apart(policy, trial.until(T), log.past)[missed:]))


def _apart(policy: Policy, trial: Trial, past: Array) -> Array:
    """Return the rms difference of each step's commands from the policy's, in units of size."""
    run = commanded(policy, trial, past)
    return np.asarray(np.sqrt((((run.asked - run.sent) / run.size) ** 2).mean(axis=1)))


def not_sent(task: Task, ran: str, missed: int) -> Finding:
    """Return that the first steps of a run were not sent."""
    pairs = zip(task.model.inputs.items(), task.past, strict=True)
    held = tuple(with_unit(f"{name} = {value:g}", unit) for (name, unit), value in pairs)
    return found("run.missed", ran=ran, steps=missed, held=held)
