"""Detect runs that failed although their log goes on: the robot fell, or its motors were cut.

After a fall a robot's program sends other commands than the policy, mostly zeros, and the log
contains them too. If the run had left [safety] by then, it counts as a failed run of the candidate,
cut there. This also covers falls near the end, where the commands as a whole still resemble the
candidate's.
"""

from __future__ import annotations

import numpy as np

from grounded.accounts.sent import EXPLAINED, FEW, FINE, LEAST, Following
from grounded.findings import Finding, Quantity, found
from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import LAST, Trial, interpolate_gaps


def fall_in(
    task: Task, own: Candidate, trial: Trial, ran: Following | None
) -> tuple[int, Finding] | None:
    """Find where a run left [safety], if its commands ceased to be the candidate's about then.

    Args:
        task: the task with [safety] and the horizon.
        own: the candidate.
        trial: the run and what follows it, with the task's states and inputs.
        ran: the comparison of its commands with the candidate's.

    Returns:
        The steps of the run before it failed, and the finding.
        None if the commands are the candidate's to the end, or never were; if the run was inside
        [safety] for `LEAST` steps before and after they ceased to be; or if it was almost complete.
    """
    ceased = None if ran is None else _ceased(task, trial, ran)
    if ceased is None or ceased < LEAST:
        return None
    assert task.safety_low is not None and task.safety_high is not None
    whole = interpolate_gaps(trial).trial
    states = whole.states[: whole.finite_steps + 1]
    beyond = np.maximum(task.safety_low - states, states - task.safety_high)
    out = beyond.max(axis=1) > 0
    begin = max(0, ceased - LEAST)
    about = out[begin : ceased + LEAST + 1]
    if not about.any():
        return None
    first = begin + int(np.argmax(about))
    inside = np.flatnonzero(~out[:first])
    first = int(inside[-1]) + 1 if len(inside) else 0
    steps = min(first, ceased)
    if steps < LEAST or steps + LAST >= task.horizon:
        return None
    i = int(np.argmax(beyond[first]))
    state, unit = list(task.model.states.items())[i]
    was, predicted = float(states[first, i]), float(own.predicted_states[first, i])
    fell = found(
        "run.fell",
        state,
        ran=own.id,
        bound=Quantity(float(np.clip(was, task.safety_low[i], task.safety_high[i])), unit),
        was=Quantity(was, unit),
        predicted=Quantity(predicted, unit),
        at=Quantity(first * task.dt, "s"),
        until=Quantity(steps * task.dt, "s"),
    )
    return steps, fell


def _ceased(task: Task, trial: Trial, ran: Following) -> int | None:
    """Return the step at which the commands of a run cease to be its candidate's, or None.

    From there they are constant although the policy would have changed them, or they are unlike the
    policy's.
    """
    T = len(ran.off)
    sent, off = trial.inputs[:T], np.nan_to_num(ran.off) / (ran.fine / FINE)
    moves = np.flatnonzero((np.abs(np.diff(sent, axis=0)) > ran.fine).any(axis=1))
    held = int(moves[-1]) + 1 if len(moves) else 0
    before, after = (float((part**2).mean()) for part in (off[: max(held, 1)], off[held:]))
    if T - held >= FEW and after > max(EXPLAINED**2, 4 * before):
        return held
    return None if ran.alike else round(ran.until_s / task.dt)
