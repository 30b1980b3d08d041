"""Detect oscillating inputs: limit cycles in trials, and jumps in plans."""

from __future__ import annotations

import math

import numpy as np

from grounded.frozen import Array, median
from grounded.search.candidate import Tried
from grounded.task import Task

# fraction of an input's range within which it counts as at its limit; share of steps that is often
NEAR, OFTEN = 0.01, 0.3
SWINGS = 6  # swings of an input about its plan by at least the plan's range: a limit cycle


def limit_cycle(tried: Tried, task: Task) -> bool:
    """Return whether feedback made an input oscillate about its plan by at least the plan's range.

    Each swing must also exceed the median offset from the plan: a sagging load, or friction that
    holds a joint, needs its gains despite the noise that they amplify.
    """
    made = tried.candidate
    range_ = np.minimum(np.ptp(made.predicted_inputs, axis=0), task.high - task.low)
    for trial in tried.trials:
        off = trial.inputs - made.predicted_inputs[: trial.steps]
        sizes = np.maximum(range_, np.abs(median(off)))
        if any(_swings(off[:, i], size) >= SWINGS for i, size in enumerate(sizes) if range_[i] > 0):
            return True
    return False


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
