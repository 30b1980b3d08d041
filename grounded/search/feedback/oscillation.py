"""Detect feedback that makes inputs oscillate: a limit cycle, which shows in a trial.

An input swings about its plan, by the plan's range or more. What a loop lacks to be stable (a
delay, a filter) is not in the model, so no prediction shows it; runs do.
"""

from __future__ import annotations

import math

import numpy as np

from grounded.frozen import Array, median
from grounded.search.candidate import Tried
from grounded.task import Task

# fraction of an input's range within which it counts as at its limit; share of steps that is often
NEAR_LIMIT, OFTEN_AT_LIMIT = 0.01, 0.3
SWINGS = 6  # swings of an input about its plan by at least the plan's range: a limit cycle


def limit_cycle(tried: Tried, task: Task) -> bool:
    """Return whether feedback made an input oscillate in a candidate's trials, see `swings`."""
    plan = tried.candidate.predicted_inputs
    range_ = np.minimum(np.ptp(plan, axis=0), task.high - task.low)
    return any((swings(plan, trial.inputs, range_) >= SWINGS).any() for trial in tried.trials)


def swings(plan: Array, sent: Array, range_: Array) -> Array:
    """Count the swings of each input about its plan in a run, (m,) int.

    Each swing is at least as large as the plan's range. It must also exceed the median offset from
    the plan: a sagging load, or friction that holds a joint, needs its gains despite the noise that
    they amplify.

    Args:
        plan: the predicted inputs (H, m).
        sent: those of the run (T, m).
        range_: of each input in the plan (m,); one with range 0 counts as never swinging.
    """
    T = min(len(plan), len(sent))  # a log may be longer
    if T < SWINGS:
        return np.zeros(len(range_), int)
    off = sent[:T] - plan[:T]
    sizes = np.maximum(range_, np.abs(median(off)))
    each = zip(off.T, sizes, range_, strict=True)
    return np.array([_swings(one, size) if of > 0 else 0 for one, size, of in each])


def between_limits(tried: Tried, task: Task) -> bool:
    """Return whether an input was at its limits, at both of them, for much of a trial."""
    range_ = task.high - task.low
    near = np.where(np.isfinite(range_), NEAR_LIMIT * range_, 0.0)
    for trial in tried.trials:
        at_low, at_high = trial.inputs <= task.low + near, trial.inputs >= task.high - near
        both = at_low.any(axis=0) & at_high.any(axis=0)
        if np.any(both & ((at_low | at_high).mean(axis=0) > OFTEN_AT_LIMIT)):
            return True
    return False


def jumps(inputs: Array, range_: Array) -> Array:
    """Count the steps in which each of the inputs (T, m) changes by over half its range, (m,)."""
    return np.asarray((np.abs(np.diff(inputs, axis=0)) > 0.5 * range_).sum(axis=0))


def _swings(values: Array, size: float) -> int:
    """Count how often a signal reverses and moves by `size` or more."""
    if not (np.abs(values - values[0]) >= size).any():  # as a rule
        return 0
    count, way, last = 0, 0.0, float(values[0])
    for value in values.tolist():  # Python's own numbers: three times as fast
        if (value - last) * way > 0:
            last = value
        elif abs(value - last) >= size:
            count, way, last = count + 1, math.copysign(1.0, value - last), value
    return count
