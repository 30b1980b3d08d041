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

from grounded.findings import Finding, found
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.search.candidate import Candidate
from grounded.search.returned.who_drove import LEAST, RESEMBLES, UNLIKE, commanded, follows
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.wording import with_unit
from grounded_trials.workspace.intake.locating.acted_on import acted_on

if TYPE_CHECKING:
    from grounded_trials.workspace.intake.locating.run_start import Recording

MOST = 5  # largest number of missed steps that is tried
COARSE = 100  # steps of a run at which a log may begin, first tried
WAITS = 3.5  # steps without a change of commands at the beginning of a log, before any run


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


def begins_late(log: Recording, policy: Policy) -> tuple[int, float]:
    """Return by how many steps a log begins after a policy's run did, 0 if it does not.

    With it, what is left of the commands, relative to their size.

    Its commands are then those of later steps, each with the gains of its own step.

    Args:
        log: the log in which no run of the policy was found.
        policy: the policy, for the states and inputs of the log.
    """
    return (0, 1.0) if _waits(log) else _step_at(log, policy, log.first)


def other_clock(log: Recording, own: Candidate) -> tuple[Finding, int, float] | None:
    """Return that a program began with a later step, since its clock ran before; or None.

    Args:
        log: the log in which no run of the candidate was found, which begins before it.
        own: the candidate, for the states and inputs of the log.

    Returns:
        The finding, the step, and what is left of the commands.
    """
    policy = own.policy
    if not _waits(log) or not log.openings:
        return None
    begins = log.on_step(policy, log.openings[0])
    step, _ = _step_at(log, policy, begins)
    fit = acted_on(log, policy.after(step), begins) if step else None
    if fit is None or not fit.throughout:
        return None
    return found("run.clock", ran=own.id, step=step, seconds=step * policy.dt), step, fit.left


def _step_at(log: Recording, policy: Policy, begins: float) -> tuple[int, float]:
    """Return the step that a policy's first command in a log is of, 0 if that is unclear.

    With it, the median difference of the commands, relative to their size.

    Args:
        log: the log.
        policy: the policy, for the states and inputs of the log.
        begins: where its first command stands [s].
    """
    trial = log.trial_from(begins)
    if trial is None:
        return 0, 1.0
    past = policy.past if trial.start_inputs is None else trial.start_inputs
    most = min(trial.finite_steps, policy.horizon)

    def left(k: int) -> float:
        """Return the median difference of commands if the first one is that of step k."""
        T = min(most, policy.horizon - k)
        if T < LEAST:
            return np.inf
        return float(np.median(_apart(policy.after(k), trial.until(T), past)))

    stride = max(1, policy.horizon // COARSE)
    best = min(range(0, policy.horizon, stride), key=left)
    best = min(range(max(0, best - stride), best + stride + 1), key=left)
    known = best > 0 and left(best) < min(RESEMBLES, UNLIKE * left(0))
    return best if known else 0, left(best)


def _waits(log: Recording) -> bool:
    """Return whether a log begins before any run: with the input held then, for some steps."""
    changed = log.changes[log.changes > log.first].min(initial=np.inf)
    held = bool((log.whole.inputs[0] == log.past).all())
    return held and changed - log.first > WAITS * log.dt


def not_sent(task: Task, ran: str, missed: int) -> Finding:
    """Return that the first steps of a run were not sent."""
    pairs = zip(task.model.inputs.items(), task.past, strict=True)
    held = tuple(with_unit(f"{name} = {value:g}", unit) for (name, unit), value in pairs)
    return found("run.missed", ran=ran, steps=missed, held=held)
