"""Checks of commands: copies of one another, constant within a trial, at or beyond their limits.

If logged commands exceed the limits, the limits are too narrow: limits taken from one log are those
of that run, not of the robot. Plans stay within them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from grounded.accounts.finding import Finding
from grounded.accounts.lag import LEAST_S, SURE, Lag, lag_between
from grounded.accounts.table import OVER
from grounded.findings import found
from grounded.frozen import Array
from grounded.model import Model
from grounded.result import extent
from grounded.task import Task
from grounded.trial import Trial

OFTEN = 0.1  # share of the time above which it is reported
COPY = 0.99  # coherence of two identical inputs: two motors of one vehicle have 0.96
FAR = 20.0  # times the limit: a value in percent exceeds it by more
ROUNDED = 0.01  # of the largest command: an excess below this is rounding


def beyond_limits(task: Task, inputs: Array) -> Array:
    """Return by how much each command (T, m) exceeds its limits, in its unit; 0 inside them.

    Args:
        task: with the limits.
        inputs: the commands (T, m) of a log; NaN counts as 0.
    """
    inputs = np.nan_to_num(inputs)
    excess = np.maximum(task.low - inputs, inputs - task.high)
    slack = ROUNDED * np.abs(inputs).max(axis=0, initial=0.0)
    return np.asarray(np.where(excess > slack, excess, 0.0))


def judge_limits(task: Task, inputs: Array) -> Iterator[Finding]:
    """Yield a finding for each command (T, m) that is often beyond or at its limits."""
    past = beyond_limits(task, inputs) > 0
    at = ((inputs <= task.low) | (inputs >= task.high)) & ~past
    for j, name in enumerate(task.model.input_names):
        share = float(past[:, j].mean())
        if share > OFTEN:
            said = found(
                "sensor.limits",
                name,
                limits=limits_of(task, j),
                share=share,
                logged=span(inputs[:, j]),
                how="percent" if in_percent(task, inputs, j) else "widen",
            )
            yield Finding(name, said, "beyond", share=share, mend=said)
        share = float(at[:, j].mean())
        if share > OFTEN:
            said = found("sensor.limits", name, at=True, share=share)
            yield Finding(name, said, "saturated", share=share)


def in_percent(task: Task, inputs: Array, j: int) -> bool:
    """Return whether a dimensionless input seems to be logged in percent.

    Args:
        task: with the limits.
        inputs: the commands (T, m) of a log.
        j: the input.
    """
    unit = list(task.model.inputs.values())[j]
    most = float(np.nanmax(np.abs(inputs[:, j]), initial=0.0))
    limit = float(max(abs(task.low[j]), abs(task.high[j])))
    return unit == "1" and FAR * limit < most <= 100 * OVER


def limits_of(task: Task, j: int) -> str:
    """Return an input's limits as text, such as `0 to 1.17 m/s`."""
    unit = task.model.inputs[task.model.input_names[j]]
    return f"{span(np.array([task.low[j], task.high[j]]))}{'' if unit == '1' else f' {unit}'}"


def span(values: Array) -> str:
    """Return the range of all values as text, such as `-1.2 to 2.15`."""
    low, high = extent(float(np.nanmin(values)), float(np.nanmax(values)))
    return f"{low:.4g} to {high:.4g}"


def judge_inputs(subject: Task | Model, trials: Sequence[Trial]) -> Iterator[Finding]:
    """Yield the findings of commands: copies, limits, inputs that are constant in each trial."""
    names = trials[0].input_names
    columns = [[trial.inputs[:, j] for trial in trials] for j in range(len(names))]
    fixed = [all(np.ptp(x) == 0 for x in some) for some in columns]
    for j, name in enumerate(names):
        values = sorted({float(x[0]) for x in columns[j]})
        if fixed[j] and len(values) > 1:
            shown = tuple(f"{v:.4g}" for v in values[:6])
            yield Finding(name, found("sensor.same", name, values=shown), "constant")
    if isinstance(subject, Task):
        yield from judge_limits(subject, np.concatenate([trial.inputs for trial in trials]))
    for i, j in combinations([j for j in range(len(names)) if not fixed[j]], 2):
        lag = lag_between(list(zip(columns[i], columns[j], strict=True)), trials[0].dt)
        if lag is not None and lag.coherence > COPY and 0.9 < lag.sign * lag.low < 1.1:
            yield _copy(names[i], names[j], lag)


def _copy(first: str, second: str, lag: Lag) -> Finding:
    """Return the finding of two inputs with one signal, perhaps a command and its measurement."""
    if lag.delay < 0:
        first, second = second, first
    d = abs(lag.delay)
    late = d if d > max(SURE * lag.std, LEAST_S) else None
    said = found("sensor.same", second, of=first, late=late)
    return Finding(second, said, "copy", d, lag.std, lag.low)
