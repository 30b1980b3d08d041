"""A run that failed in a log that goes on: the robot fell, its motors were cut, nobody took over.

Once a robot is down its program sends something else than the policy, zeros mostly, and the log has
that, too. Where the run had left [safety] by then it is the candidate's, and failed there, as if
the log had ended with it: also where so little of the run was left that its commands are like the
candidate's on the whole, as one input is held to the end that the policy would have moved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import LAST, Trial, interpolate_gaps
from grounded_trials.wording import with_unit
from grounded_trials.workspace.intake.acted_on import acted_on
from grounded_trials.workspace.intake.run_start import Recording, Start
from grounded_trials.workspace.intake.who_drove import FINE, LEAST, SAME, Following


@dataclass(frozen=True)
class Fall:
    """Where a run failed, and what a person should know of it."""

    steps: int  # of the run until there
    told: str


def fall_in(task: Task, own: Candidate, trial: Trial, ran: Following | None) -> Fall | None:
    """Where a run had left [safety] when its commands ceased to be its candidate's.

    Args:
        task: whose [safety] and horizon hold.
        own: the candidate.
        trial: the run and what follows it, of the task's states and inputs.
        ran: how its commands compare with the candidate's.

    Returns:
        None where they are the candidate's to the end, or never were, where the run was in [safety]
        for `LEAST` steps before and after they ceased to be, or was all but over.
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
    i, name = int(np.argmax(beyond[first])), own.id
    state, unit = list(task.model.states.items())[i]
    was, predicted = (with_unit(f"{x[first, i]:.3g}", unit) for x in (states, own.predicted_states))
    low, high = task.safety_low[i], task.safety_high[i]
    return Fall(
        steps,
        f"{state} left [safety] = [{low:g}, {high:g}] at {first * task.dt:.2f} s (it was {was}, "
        f"where {predicted} was predicted), and the commands are those of {name} up to "
        f"{ceased * task.dt:.2f} s only: this counts as a failed run of {name}, cut at "
        f"{steps * task.dt:.2f} s; what came before is kept for fit and diagnose, what follows is "
        "not judged. If something disturbed it, `discard` it",
    )


def _ceased(task: Task, trial: Trial, ran: Following) -> int | None:
    """The step at which the commands of a run cease to be its candidate's; None: they don't.

    Held from there to the end, where the policy would have moved them; or unlike the policy's.
    """
    T = len(ran.off)
    sent, off = trial.inputs[:T], np.nan_to_num(ran.off) / (ran.fine / FINE)
    moves = np.flatnonzero((np.abs(np.diff(sent, axis=0)) > ran.fine).any(axis=1))
    held = int(moves[-1]) + 1 if len(moves) else 0
    before, after = (float((part**2).mean()) for part in (off[: max(held, 1)], off[held:]))
    if T - held >= FEW and after > max(STOPPED**2, 4 * before):
        return held
    return None if ran.alike else round(ran.until_s / task.dt)


FEW = 5  # steps for which inputs are held at least when the motors are cut,
STOPPED = 0.1  # of an input: by so much the policy would have moved it, rms


def who_fell(
    log: Recording,
    own: Candidate,
    candidates: Sequence[Candidate],
    start_of: Callable[[Candidate], Start | None],
    end: float,
) -> str:
    """The candidate whose commands were sent until a fall; "" if the own one's are as near.

    Args:
        log: in which the run begins, and fails.
        own: the candidate that it is said to have run.
        candidates: those that may have been run instead.
        start_of: where a candidate's run seems to begin in the log.
        end: when the run had failed, seconds after the log's first sample.
    """

    def left(one: Candidate) -> float:
        start = start_of(one)
        fit = acted_on(log, one.policy, start.seconds) if start and start.opens_alike else None
        if start is None or fit is None:
            return np.inf
        off = fit.off[: max(0, round((end - start.seconds) / log.dt))]
        off = off[np.isfinite(off)]
        return float(np.median(off)) if len(off) >= LEAST else np.inf

    others = {one.id: left(one) for one in candidates if one.id != own.id}
    nearest = min(others, key=others.__getitem__, default="")
    return nearest if nearest and others[nearest] < SAME * max(left(own), FINE) else ""
