"""Commands at their limits, and beyond: where a log goes beyond, the limits are too narrow.

Limits that were read off one log are those of that drive, not of the robot. A plan keeps to them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from grounded.frozen import Array
from grounded.instruments.finding import Finding
from grounded.task import Task

OFTEN = 0.1  # of the time
ROUNDED = 0.01  # of the largest command: so much beyond a limit is a matter of digits


def beyond_limits(task: Task, inputs: Array) -> Array:
    """By how much each command (T, m) is beyond its limits, in its unit; 0 where it is not.

    Args:
        task: whose limits hold.
        inputs: the commands (T, m) of a log; NaN counts for nothing.
    """
    inputs = np.nan_to_num(inputs)
    excess = np.maximum(task.low - inputs, inputs - task.high)
    slack = ROUNDED * np.abs(inputs).max(axis=0, initial=0.0)
    return np.asarray(np.where(excess > slack, excess, 0.0))


def judge_limits(task: Task, inputs: Array) -> Iterator[Finding]:
    """Of commands (T, m) that are beyond their limits or at them for much of the time."""
    past = beyond_limits(task, inputs) > 0
    at = ((inputs <= task.low) | (inputs >= task.high)) & ~past
    for j, name in enumerate(task.model.input_names):
        share = float(past[:, j].mean())
        if share > OFTEN:
            text = (
                f"beyond its limits, {limits_of(task, j)}, {100 * share:.0f} % of the time "
                f"({span(inputs[:, j])}): widen [limits] if the robot may get that"
            )
            yield Finding(name, text, "beyond", share=share)
        share = float(at[:, j].mean())
        if share > OFTEN:
            text = f"at its limits {100 * share:.0f} % of the time"
            yield Finding(name, text, "saturated", share=share)


def limits_of(task: Task, j: int) -> str:
    """`0 to 1.17 m/s`."""
    unit = task.model.inputs[task.model.input_names[j]]
    return f"{span(np.array([task.low[j], task.high[j]]))}{'' if unit == '1' else f' {unit}'}"


def span(values: Array) -> str:
    """`-1.2 to 2.15`, the lowest to the highest of all values."""
    return f"{np.nanmin(values):.4g} to {np.nanmax(values):.4g}"
