"""Detect oscillating inputs: limit cycles in trials, and jumps in plans."""

from __future__ import annotations

import math

import numpy as np

from grounded.frozen import Array, median
from grounded.search.candidate import Candidate, Tried
from grounded.task import Task
from grounded.trial import Trial

# fraction of an input's range within which it counts as at its limit; share of steps that is often
NEAR, OFTEN = 0.01, 0.3
SWINGS = 6  # swings of an input about its plan by at least the plan's range: a limit cycle


def limit_cycle(tried: Tried, task: Task, range_: Array | None = None) -> bool:
    """Return whether feedback made an input oscillate in a candidate's trials, see `swings`."""
    range_ = plan_range(tried.candidate, task) if range_ is None else range_
    made = tried.candidate
    return any((swings(made, trial, range_) >= SWINGS).any() for trial in tried.trials)


def swings(made: Candidate, trial: Trial, range_: Array) -> Array:
    """Count the swings of each input about a candidate's plan in one of its runs, (m,) int.

    Each swing is at least as large as a plan's range. It must also exceed the median offset from
    the plan: a sagging load, or friction that holds a joint, needs its gains despite the noise that
    they amplify.

    Args:
        made: the candidate.
        trial: its run.
        range_: range of each input in its plan, or in one that replays no swings (m,); an input
            with range 0 counts as never swinging.
    """
    plan = made.predicted_inputs
    if trial.steps < SWINGS:
        return np.zeros(len(range_), int)
    off = trial.inputs[: len(plan)] - plan[: trial.steps]  # a log may be longer
    sizes = np.maximum(range_, np.abs(median(off)))
    each = zip(off.T, sizes, range_, strict=True)
    return np.array([_swings(one, size) if of > 0 else 0 for one, size, of in each])


def plan_range(made: Candidate, task: Task) -> Array:
    """Return the range of each input in a candidate's plan, at most that of its limits, (m,)."""
    return np.asarray(np.minimum(np.ptp(made.predicted_inputs, axis=0), task.high - task.low))


def between_limits(tried: Tried, task: Task) -> bool:
    """Return whether an input was at its limits, at both of them, for much of a trial."""
    range_ = task.high - task.low
    near = np.where(np.isfinite(range_), NEAR * range_, 0.0)
    for trial in tried.trials:
        at_low, at_high = trial.inputs <= task.low + near, trial.inputs >= task.high - near
        both = at_low.any(axis=0) & at_high.any(axis=0)
        if np.any(both & ((at_low | at_high).mean(axis=0) > OFTEN)):
            return True
    return False


def jumps(inputs: Array, range_: Array) -> Array:
    """Count the steps in which each of the inputs (T, m) changes by over half its range, (m,)."""
    return np.asarray((np.abs(np.diff(inputs, axis=0)) > 0.5 * range_).sum(axis=0))


def _swings(values: Array, size: float) -> int:
    """Count how often a signal reverses and moves by `size` or more."""
    if not (np.abs(values - values[0]) >= size).any():  # as a rule
        return 0
    found, way, last = 0, 0.0, float(values[0])
    for value in values.tolist():  # Python's own numbers: three times as fast
        if (value - last) * way > 0:
            last = value
        elif abs(value - last) >= size:
            found, way, last = found + 1, math.copysign(1.0, value - last), value
    return found
