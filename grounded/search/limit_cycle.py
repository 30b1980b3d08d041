"""Inputs that swing: a trial that was a limit cycle about its plan, a plan that jumps."""

from __future__ import annotations

import math

import numpy as np

from grounded.frozen import Array, median
from grounded.search.candidate import Tried
from grounded.task import Task

NEAR, OFTEN = 0.01, 0.3  # of its range; of the steps
SWINGS = 6  # of an input about its plan, each as large as the plan's own range: a limit cycle


def limit_cycle(tried: Tried, task: Task) -> bool:
    """Whether feedback swung an input to and fro about its plan, each time by the plan's range.

    And by more than it is off lastingly: a load that sags, or friction that holds a joint, needs
    the gains that it has, whatever noise they carry.
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
    """Whether feedback held an input at one limit or the other for much of a trial."""
    range_ = task.high - task.low
    near = np.where(np.isfinite(range_), NEAR * range_, 0.0)
    for trial in tried.trials:
        at_low, at_high = trial.inputs <= task.low + near, trial.inputs >= task.high - near
        both = at_low.any(axis=0) & at_high.any(axis=0)
        if np.any(both & ((at_low | at_high).mean(axis=0) > OFTEN)):
            return True
    return False


def jumps(inputs: Array, range_: Array) -> Array:
    """How often inputs (T, m) go over half their range (m,) or more within one step, (m,)."""
    return np.asarray((np.abs(np.diff(inputs, axis=0)) > 0.5 * range_).sum(axis=0))


def _swings(values: Array, size: float) -> int:
    """How often a signal moves by `size` or more, each time against the time before."""
    found, way, last = 0, 0.0, float(values[0])
    for value in values.tolist():  # Python's own numbers: three times as fast
        if (value - last) * way > 0:
            last = value
        elif abs(value - last) >= size:
            found, way, last = found + 1, math.copysign(1.0, value - last), value
    return found
