"""What a task's configuration leaves open, told with its first plan: limits, idle inputs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from grounded.findings import Finding, found
from grounded.frozen import Array
from grounded.places import samples
from grounded.task import Task
from grounded_trials.workspace.folder import Folder

if TYPE_CHECKING:
    from grounded.search.candidate import Candidate


def left_open(workspace: Folder, made: Candidate | None) -> Iterator[Finding]:
    """Yield what the operator should know of the configuration before the first run."""
    task = workspace.task
    if free := unlimited(task):
        yield found("plan.no_limits", *free)
    if made is not None:
        sent = made.predicted_inputs
        if idle := idle_inputs(task, made.predicted_states[: len(sent)], sent):
            yield no_effect(workspace, idle)
    if log := workspace.config.seen_in:
        yield found("plan.limits_of_log", log=log)


def unlimited(task: Task) -> list[str]:
    """Return the inputs that lack a limit."""
    ends = zip(task.model.input_names, task.low, task.high, strict=True)
    return [name for name, *both in ends if not np.isfinite(both).all()]


def idle_inputs(task: Task, states: Array, inputs: Array) -> list[str]:
    """Return the inputs that change no step of the model at either of their limits.

    An example is a gain that is still 0 in a model skeleton. A rudder acts only at some speed, and
    a plan may stay at rest: so the model is also probed at other states and inputs.
    """
    some, sent = samples(task.model, 8)
    x = np.concatenate([states, some])
    sent, idle = np.concatenate([inputs, np.clip(sent, task.low, task.high)]), []
    for j, name in enumerate(task.model.input_names):
        after = []
        for end, other in ((task.low[j], sent[:, j] - 1), (task.high[j], sent[:, j] + 1)):
            u = sent.copy()
            u[:, j] = end if np.isfinite(end) else other
            after.append(task.model.system.step(x, u, task.model.values, task.dt))
        if task.low[j] < task.high[j] and np.array_equal(after[0], after[1]):
            idle.append(name)
    return idle


def no_effect(workspace: Folder, idle: Sequence[str]) -> Finding:
    """Return that inputs have no effect in the model."""
    return found("plan.without_effect", *idle, file=workspace.config.model.file or "the model")
