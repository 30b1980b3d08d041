"""Where the run of a candidate begins in a log, and whether it fell.

After a fall, or when its motors are cut, a robot's program sends other commands than the policy,
mostly zeros, and the log contains them too. If the run had left [safety] by then, it counts as a
failed run of the candidate, cut there. This also covers falls near the end, where the commands as a
whole still resemble the candidate's.
"""

from __future__ import annotations

import numpy as np

from grounded.accounts.levels import EXPLAINED, FINE, LATEST, STEPS_TO_JUDGE
from grounded.accounts.sent import Following, follows
from grounded.findings import Finding, Quantity, found
from grounded.policy import Policy
from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import LAST, Trial, interpolate_gaps
from grounded_trials.workspace.intake.opening.run_start import Recording, Start

LOOSE = 0.1  # distance from the first command, in steps, above which it is another start
ALIGNED = 0.75  # starts closer than this, in sample intervals, are considered equal
CLEARLY = 0.7  # a start is elsewhere if its difference is below this share of the first command's


def elsewhere(log: Recording, start: Start, policy: Policy) -> bool:
    """Return whether a run begins at the start found rather than at the log's first command.

    The first command of a busy computer may be late. If the run began with it, all others would be
    early, and would be compared with states that the program did not have yet.
    """
    off = abs(start.seconds - log.first)
    if not start.opens_alike or off <= ALIGNED * log.interval:
        return start.alike and off > LOOSE * log.dt and not log.late.any()
    if start.ran.exact or start.apart < CLEARLY * log.apart_at(policy, log.first):
        return True
    first = log.trial_from(log.first)
    ran = None if first is None else follows(policy, first.until(policy.horizon), LATEST)
    return ran is not None and not ran.alike


# --- a run that failed although its log goes on ---------------------------------------------------


def fall_in(
    task: Task, own: Candidate, trial: Trial, ran: Following | None
) -> tuple[int, Finding] | None:
    """Find where a run left [safety], if its commands ceased to be the candidate's about then.

    Returns:
        The steps of the run before it failed, and the finding.
        None if the commands are the candidate's to the end, or never were; if the run was inside
        [safety] for `STEPS_TO_JUDGE` steps before and after they ceased to be; or if it was almost
        complete.
    """
    ceased = None if ran is None else _ceased(task, trial, ran)
    if ceased is None or ceased < STEPS_TO_JUDGE:
        return None
    whole = interpolate_gaps(trial).trial
    states = whole.states[: whole.finite_steps + 1]
    safe = task.inside_safety(states)
    beyond = np.abs(states - safe)
    out = np.asarray(beyond.any(axis=1))
    begin = max(0, ceased - STEPS_TO_JUDGE)
    about = np.flatnonzero(out[begin : ceased + STEPS_TO_JUDGE + 1])
    if not len(about):
        return None
    inside = np.flatnonzero(~out[: begin + about[0]])
    first = int(inside[-1]) + 1 if len(inside) else 0
    steps = min(first, ceased)
    if steps < STEPS_TO_JUDGE or steps + LAST >= task.horizon:
        return None
    i = int(np.argmax(beyond[first]))
    state, unit = list(task.model.states.items())[i]
    was, predicted = float(states[first, i]), float(own.predicted_states[first, i])
    fell = found(
        "run.fell",
        state,
        ran=own.id,
        bound=Quantity(float(safe[first, i]), unit),
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
    if T - held >= STEPS_TO_JUDGE and after > max(EXPLAINED**2, 4 * before):
        return held
    return None if ran.alike else round(ran.until_s / task.dt)
