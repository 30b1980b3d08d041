"""Checks of the first plan of a task: what its configuration lacks or asks too much of.

Each check is a function of the `Plan`; `CHECKS` lists them in the order in which they are told. A
task may name no limits, ask for more than they allow, or weigh inputs so much that errors hardly
count.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from grounded.findings import Finding, Quantity, found
from grounded.frozen import Array
from grounded.places import samples
from grounded.task import Task
from grounded_trials.workspace.candidates.at_rest import held_before
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.off_target import tracking_error, weighed_groups

if TYPE_CHECKING:
    from grounded.search.candidate import Candidate
    from grounded.search.standing import Proposal

# share of the target's extent above which a plan's error is told: where inputs are at their limits
# for the share LIMITED of the plan, and at its end
MISSED, SHORT, LIMITED = 0.05, 0.25, 0.25


@dataclass(frozen=True, eq=False)
class Plan:
    """The first plan of a workspace: `made` is None if it was refused, `refused` if it was not."""

    workspace: Folder
    made: Candidate | None
    refused: Candidate | None

    @property
    def task(self) -> Task:
        """The task with the crude model."""
        return self.workspace.task


def left_open(workspace: Folder, proposal: Proposal) -> list[Finding]:
    """Return what the operator should know of the configuration before the first run.

    If one has a command, that comes first: a second `propose` hands the candidate out.

    Args:
        workspace: a workspace in which nothing was run yet.
        proposal: the first plan, or why there is none.
    """
    plan = Plan(workspace, proposal.candidate, proposal.refused)
    return [one for check in CHECKS for one in check(plan)]


def no_limits(plan: Plan) -> Iterator[Finding]:
    """An input has no limits."""
    task = plan.task
    ends = zip(task.model.input_names, task.low, task.high, strict=True)
    if free := [name for name, *both in ends if not np.isfinite(both).all()]:
        yield found("plan.no_limits", *free)


def idle_inputs(task: Task, states: Array, inputs: Array) -> list[str]:
    """Return the inputs that change no step of the model at either of their limits.

    An example is a gain that is still 0 in a model skeleton. A rudder acts only at some speed, and
    a plan may stay at rest: so the model is also probed at other states and inputs.

    Args:
        task: the task with the model and the limits.
        states: where the model is probed too (N, n).
        inputs: the inputs there (N, m).
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


def without_effect(plan: Plan) -> Iterator[Finding]:
    """An input changes no step of the model, along the plan or elsewhere."""
    if plan.made is not None:
        sent = plan.made.predicted_inputs
        if idle := idle_inputs(plan.task, plan.made.predicted_states[: len(sent)], sent):
            yield no_effect(plan.workspace, idle)


def no_effect(workspace: Folder, idle: Sequence[str]) -> Finding:
    """Return that inputs have no effect in the model."""
    return found("plan.without_effect", *idle, file=workspace.config.model.file or "the model")


def limits_of_log(plan: Plan) -> Iterator[Finding]:
    """[limits] are only what a log used."""
    if log := plan.workspace.config.seen_in:
        yield found("plan.limits_of_log", log=log)


def off_target(plan: Plan) -> Iterator[Finding]:
    """The plan misses its target: by [limits], by other weights, or as the model can't reach it."""
    if plan.made is None or not weighed_groups(plan.task):
        return
    task, sent, aim = plan.task, plan.made.predicted_inputs, plan.task.input_target
    assert aim is not None

    # The share of the plan for which each input is at a limit that it does not aim at.
    at_limit = np.zeros(sent.shape, bool)
    for end in (task.low, task.high):
        meant = np.isclose(aim, end).all(axis=0) | ~np.isfinite(end)
        at_limit |= np.isclose(sent, end, rtol=1e-3, atol=1e-9) & ~meant
    shares = at_limit.mean(axis=0)
    at = [
        name for name, share in zip(task.model.input_names, shares, strict=True) if share > LIMITED
    ]

    # The largest error there, or else that at the end, as a share of what the target extends over.
    missed, errors = tracking_error(task, plan.made.predicted_run), []
    for names, what in weighed_groups(task):
        states = [task.model.state_names.index(name) for name in names]
        far = np.linalg.norm(missed[:, states], axis=1)
        off = float(far.max() if at else far[-1])
        extent = np.ptp(np.vstack([task.start, task.target])[:, states], axis=0)
        errors.append((off / max(float(np.linalg.norm(extent)), 1e-300), off, what, names[0]))
    share, off, what, name = max(errors) if at else errors[0]
    if share > (MISSED if at else SHORT):
        most = float(shares.max()) if at else None
        missing = Quantity(off, task.model.states[name])
        yield found("plan.falls_short", *at, share=most, what=what, off=missing)


def unguarded(plan: Plan) -> Iterator[Finding]:
    """States leave [safety] in a refused plan that have no target, or no weight on it."""
    if plan.refused is None:
        return
    task, states = plan.task, plan.refused.predicted_states
    out = (states != task.inside_safety(states)).any(axis=0)
    weight = task.reward.state + task.reward.terminal
    given, names = np.isfinite(task.target).any(axis=0), task.model.state_names
    for which, unweighed in ((~given, 0), (given & (weight == 0), 1)):
        if bare := [names[i] for i in np.flatnonzero(out & which)]:
            yield found("plan.unguarded", *bare, unweighed=unweighed)


def not_at_rest(plan: Plan) -> Iterator[Finding]:
    """The robot is not at rest at its start, but would be under another input."""
    if one := held_before(plan.workspace):
        yield one


CHECKS: Sequence[Callable[[Plan], Iterator[Finding]]] = (
    no_limits,
    without_effect,
    limits_of_log,
    off_target,
    unguarded,
    not_at_rest,
)
