"""A run that failed in a log that goes on: the robot fell, its motors were cut, nobody took over.

Once a robot is down its program sends something else than the policy, zeros mostly, and the log has
that, too. Where the run had left [safety] by then it is the candidate's, and failed there, as if
the log had ended with it.
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


def fall_in(task: Task, name: str, trial: Trial, ran: Following | None) -> Fall | None:
    """Where a run had left [safety] when its commands ceased to be its candidate's.

    Args:
        task: whose [safety] and horizon hold.
        name: of the candidate.
        trial: the run and what follows it, of the task's states and inputs.
        ran: how its commands compare with the candidate's.

    Returns:
        None where they are the candidate's to the end, or never were, where the run was in [safety]
        for `LEAST` steps before and after they ceased to be, or was all but over.
    """
    if ran is None or ran.alike or ran.until_s < LEAST * task.dt:
        return None
    assert task.safety_low is not None and task.safety_high is not None
    whole = interpolate_gaps(trial).trial
    states = whole.states[: whole.finite_steps + 1]
    beyond = np.maximum(task.safety_low - states, states - task.safety_high)
    out, ceased = beyond.max(axis=1) > 0, round(ran.until_s / task.dt)
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
    was = with_unit(f"{states[first, i]:.3g}", unit)
    low, high = task.safety_low[i], task.safety_high[i]
    return Fall(
        steps,
        f"{state} left [safety] = [{low:g}, {high:g}] at {first * task.dt:.2f} s (it was {was}), "
        f"and the commands are those of {name} up to {ran.until_s:.2f} s only: this counts as a "
        f"failed run of {name}, cut at {steps * task.dt:.2f} s, and what follows is not judged. If "
        "something disturbed it, `discard` it",
    )


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
