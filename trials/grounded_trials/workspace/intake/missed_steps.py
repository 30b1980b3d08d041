"""A run whose first steps were never sent: it begins before its log's first command.

A program whose timer came late skips step 0, as the runner does for calls that were missed, and the
log's first command is that of step 1. Counted as step 0, every command is judged by its neighbour's
gains and reference; where those differ little from step to step, it looks like the run. So the log
is laid so many steps earlier, too, with what was held before the run in place of what was not sent,
and the commands that were sent are compared with what the policy makes of the states there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from grounded.policy import Policy
from grounded.result import listed
from grounded.task import Task
from grounded_trials.wording import count, with_unit
from grounded_trials.workspace.intake.acted_on import acted_on
from grounded_trials.workspace.intake.who_drove import LEAST, follows

if TYPE_CHECKING:
    from grounded_trials.workspace.intake.run_start import Recording

MOST = 5  # steps that a program misses before its first
BY_FAR = 0.25  # of what is left of the commands elsewhere: the run lies where no more is left


def missed_steps(log: Recording, policy: Policy, first: float, found: float) -> int:
    """How many steps of a policy's run lie before the log's first command; 0: none, or unclear.

    Args:
        log: in which the run begins.
        policy: of its states and inputs.
        first: the first command, moved to where a step begins [s].
        found: where else the run seems to begin [s].
    """
    usual = acted_on(log, policy, found)
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
    return k if alike and usual is not None and there.left < BY_FAR * usual.left else 0


def _left(log: Recording, policy: Policy, first: float, missed: int) -> float:
    """What half of the commands that were sent are off by, on the states of their time."""
    trial = log.trial_from(first - missed * log.dt)
    T = 0 if trial is None else min(trial.finite_steps, policy.horizon)
    if trial is None or T - missed < LEAST:
        return np.inf
    sent = np.clip(trial.inputs[:T], policy.low, policy.high)
    asked = policy.commands(trial.states[None, :T], log.past, sent[None])[0]
    size = np.maximum(np.abs(policy.feedforward).max(axis=0), np.abs(sent).max(axis=0)) + 1e-12
    off = np.sqrt((((asked - sent) / size) ** 2).mean(axis=1))
    return float(np.median(off[missed:]))


def not_sent(task: Task, ran: str, missed: int) -> str:
    """What a person should know of it."""
    held = listed(
        f"{name} = {with_unit(f'{value:g}', unit)}"
        for (name, unit), value in zip(task.model.inputs.items(), task.past, strict=True)
    )
    gone = "step 0 was" if missed == 1 else f"steps 0 to {missed - 1} were"
    return (
        f"the log's first command is that of step {missed} of {ran}: {gone} not sent, or not "
        f"logged. The run begins {count(missed, 'step')} ({missed * task.dt:.3g} s) before it, "
        f"with {held} held until then. Let the program send from step 0 on (a timer that fires "
        "late skips it), and record from before that"
    )
