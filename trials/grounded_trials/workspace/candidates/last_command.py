"""Tell whether a plan reaches its target only by a last command at its limit.

Weights of the last state alone are met by a kick in the last steps, for one sample: by the model,
the robot leaves the target in the next second. An arm at rest against its weight leaves it, too,
but because the input that is sent afterwards lets it go.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from grounded.findings import Finding, Quantity, found
from grounded.frozen import Array
from grounded.places import integrals
from grounded.search.planner import Planner
from grounded.search.safety import as_sent, coasting
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.workspace.off_target import reaches, weighed_groups

AWAY = 0.02  # drift after a run, relative to the target's extent, above which it is reported
REACHED = 0.05  # of the target's extent: a plan that ends farther away does not reach it
LAST_STEPS, AT_LIMIT = 3, 1e-3  # steps of a kick; distance from a limit, as a share of the range
CAUSED = 0.5  # share of the drift that the model must predict from rest, under the input held


def kicked(planner: Planner, run: Trial, held: Array) -> Finding | None:
    """Return that a plan leaves its target after a last command at its limit, if it does.

    Args:
        planner: the task, and the model with adopted effects.
        run: the predicted run, with the planning model's states.
        held: the input that is sent after it (m,).
    """
    task = planner.task
    groups = weighed_groups(task) if reaches(task) else []
    ends = np.vstack([task.low, task.high])
    full = np.ptp(np.where(np.isfinite(ends), ends, 0.0), axis=0) * AT_LIMIT
    at = (np.abs(run.inputs[-LAST_STEPS:] - ends[:, None]) <= full).any(axis=(0, 1))
    at &= ~(np.abs(held - ends) <= full).any(axis=0) & (full > 0)
    if not groups or not at.any():
        return None
    names, what = groups[0]
    states, next_s = [task.model.state_names.index(n) for n in names], math.ceil(1.0 / task.dt)
    after = coasting(planner.plan, run, held)[: 1 + next_s, : task.model.n]
    errors = task.model.difference(after, task.target[-1])[:, states]
    way = float(np.linalg.norm(np.ptp(np.vstack([task.start, task.target])[:, states], axis=0)))
    off = np.linalg.norm(errors, axis=1)
    worst = int(np.argmax(off))
    if off[0] > REACHED * way or not off[worst] > max(AWAY * way, 2 * off[0]):
        return None
    let = coasting(planner.plan, ended_at_rest(task, run, held), held)[: 1 + next_s, : task.model.n]
    drift = np.linalg.norm(task.model.difference(let, let[:1])[:, states], axis=1)
    sent = tuple(n for n, odd in zip(task.model.input_names, at, strict=True) if odd)
    return found(
        "plan.last_command",
        *sent,
        what=what,
        off=Quantity(off[worst], task.model.states[names[0]]),
        at=Quantity(worst * task.dt, "s"),
        held=as_sent(task.model, held),
        let_go=int(drift.max() > CAUSED * off[worst]),
    )


def ended_at_rest(task: Task, run: Trial, held: Array) -> Trial:
    """Return a run that ends where a predicted one does, but at rest and under the held input.

    Args:
        task: says which states are rates of positions.
        run: the predicted run, with the planning model's states.
        held: the input that is sent after it (m,).
    """
    still = run.states.copy()
    still[-1, [one.j for one in integrals(task.model) if one.exact]] = 0.0
    return replace(run, states=still, inputs=np.tile(held, (run.steps, 1)), start_inputs=held)
