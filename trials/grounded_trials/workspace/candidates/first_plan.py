"""Checks of the first plan of a task: what its configuration lacks or asks too much of.

Each check is a function of the `Plan`; `CHECKS` lists them in the order in which they are told. A
task may name no limits, ask for more than they allow, or weigh inputs so much that errors hardly
count or so little that sensor noise shakes them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from grounded.errors import NextCommand
from grounded.findings import Finding, Quantity, Weight, found
from grounded.places import samples
from grounded.search.feedback.oscillation import jumps
from grounded.search.scatter import sensor_noise
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.wording import rendered
from grounded_trials.workspace.candidates.at_rest import drawn, held_before, to_end_at_rest
from grounded_trials.workspace.candidates.exporting import to_run
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.new_target import still_logged
from grounded_trials.workspace.off_target import tracking_error, weighed_groups
from grounded_trials.workspace.user_files.config import made_changes
from grounded_trials.workspace.user_files.task_file import limited_changes, seen_in

if TYPE_CHECKING:
    from grounded.search.candidate import Candidate
    from grounded.search.standing import Proposal

LIMITED = 0.25  # share of a plan at the limits of an input, which keep it off its target then
MISSED = 0.05  # share of the target's extent above which an error is told; SHORT: at the plan's end
SHORT = 0.25
SHAKEN = 0.05  # share of an input's [limits] (else of its range in the plan) moved by noise
PIECES = 10  # pieces of the plan in which the effect of noise is computed
OFTEN = 4  # jumps over half the range of an input; a quick manoeuvre has two or three
OTHER = 1.5  # ratio of weights above which a weight was made for other [limits]


@dataclass(frozen=True, eq=False)
class Plan:
    """The first plan of a workspace, or why there is none, with what several checks need.

    Args:
        workspace: a workspace in which nothing was run yet.
        made: the first candidate; None if it was refused.
        refused: the refused one; None if there is a candidate.
        again: whether another model was used for an earlier plan.
    """

    workspace: Folder
    made: Candidate | None
    refused: Candidate | None
    again: bool = False

    @property
    def task(self) -> Task:
        """The task with the crude model."""
        return self.workspace.task

    def at_limits(self, made: Candidate) -> Iterator[tuple[str, float]]:
        """Yield the share of a plan for which each input is at one of its limits."""
        task, aim = self.task, self.task.input_target
        assert aim is not None
        for j, name in enumerate(task.model.input_names):
            ends = [float(end) for end in (task.low[j], task.high[j]) if np.isfinite(end)]
            ends = [end for end in ends if not np.allclose(aim[:, j], end)]
            sent = made.predicted_inputs[:, j]
            at = [np.isclose(sent, end, rtol=1e-3, atol=1e-9) for end in ends]
            yield name, float(np.any(at, axis=0).mean()) if at else 0.0


def left_open(workspace: Folder, proposal: Proposal, again: bool) -> list[Finding]:
    """Return what the operator should know of the configuration before the first run.

    If one has a command, that comes first: a second `propose` hands the candidate out.

    Args:
        workspace: a workspace in which nothing was run yet.
        proposal: the first plan, or why there is none.
        again: whether another model was used for an earlier plan.
    """
    plan, told = Plan(workspace, proposal.candidate, proposal.refused, again), list[Finding]()
    for check in CHECKS:
        asked = any(one.then for one in told)
        told += [one for one in check(plan) if not (one.then and asked)]
    unsaid = not {"plan.unguarded", "plan.not_at_rest"} & {one.code for one in told}
    if plan.refused is not None and unsaid and leaving(plan).any():
        told.append(found("plan.leaves"))
    return told


def no_motion(plan: Plan) -> Iterator[Finding]:
    """The target stays where the run starts."""
    if np.allclose(plan.task.target, plan.task.start):
        yield found("plan.no_motion")


def no_limits(plan: Plan) -> Iterator[Finding]:
    """An input has no limits."""
    task = plan.task
    ends = zip(task.model.input_names, task.low, task.high, strict=True)
    if free := [name for name, *both in ends if not np.isfinite(both).all()]:
        yield found("plan.no_limits", *free)


def without_effect(plan: Plan) -> Iterator[Finding]:
    """An input changes no step of the model, along the plan or elsewhere, at either of its limits.

    An example is a gain that is still 0 in a model skeleton. A rudder acts only at some speed, and
    a plan may stay at rest: so the model is also probed at other states and inputs.
    """
    if plan.made is None:
        return
    task, sent, idle = plan.task, plan.made.predicted_inputs, []
    states, inputs = samples(task.model, 8)
    x = np.concatenate([plan.made.predicted_states[: len(sent)], states])
    sent = np.concatenate([sent, np.clip(inputs, task.low, task.high)])
    for j, name in enumerate(task.model.input_names):
        after = []
        for end, other in ((task.low[j], sent[:, j] - 1), (task.high[j], sent[:, j] + 1)):
            u = sent.copy()
            u[:, j] = end if np.isfinite(end) else other
            after.append(task.model.system.step(x, u, task.model.values, task.dt))
        if task.low[j] < task.high[j] and np.array_equal(after[0], after[1]):
            idle.append(name)
    if idle:
        file = plan.workspace.config.model.file or "the model"
        yield found("plan.without_effect", *idle, file=file)


def limits_of_log(plan: Plan) -> Iterator[Finding]:
    """[limits] are only what a log used."""
    if not (log := seen_in(plan.workspace.config)):
        return
    shares = [] if plan.made is None else [*plan.at_limits(plan.made)]
    share, at = max(((share, name) for name, share in shares), default=(0.0, ""))
    yield found(
        "plan.limits_of_log",
        log=log,
        at=at or None,
        share=share,
        logged=int(still_logged(plan.workspace)),
    )


def of_other_limits(plan: Plan) -> Iterator[Finding]:
    """Weights on input changes were made for other [limits] than the current ones."""
    config, model = plan.workspace.config, plan.workspace.base_model
    made = made_changes(config.file.read_text(encoding="utf-8"))
    weights = dict(zip(model.input_names, plan.task.reward.input_change, strict=True))
    now = {name: by for name, (_, by) in limited_changes(config, model).items()}
    off = [
        name
        for name, by in now.items()
        if weights[name] == made.get(name) and not 1 / OTHER < weights[name] / by < OTHER
    ]
    if off:
        new = ", ".join(f"{name} = {now.get(name, w):.4g}" for name, w in weights.items() if w)
        yield found("plan.of_other_limits", *off, new=f"{{ {new} }}")


def off_target(plan: Plan) -> Iterator[Finding]:
    """The plan misses its target: by [limits], by other weights, or as the model can't reach it."""
    if plan.made is None or not (groups := weighed_groups(plan.task)):
        return
    task, limited = plan.task, [*plan.at_limits(plan.made)]
    what, off, share = _most_missed(task, plan.made.predicted_run)
    at = [name for name, part in limited if part > LIMITED]
    if at and share > MISSED:
        most = max(part for _, part in limited)
        yield found("plan.falls_short", *at, share=most, what=what, off=off)
        return
    names, what = groups[0]
    states, unit = [task.model.state_names.index(n) for n in names], task.model.states[names[0]]
    last = task.model.difference(plan.made.predicted_states[-1], task.target[-1])[states]
    short, extent = float(np.linalg.norm(last)), _extent(task, states)
    if short > SHORT * extent > 0:
        yield found("plan.falls_short", what=what, off=Quantity(short, unit))


def _extent(task: Task, states: Sequence[int]) -> float:
    """Return the diagonal of the box that the start and the target of some states span."""
    return float(np.linalg.norm(np.ptp(np.vstack([task.start, task.target])[:, states], axis=0)))


def _most_missed(task: Task, run: Trial) -> tuple[str, Quantity, float]:
    """Return what a plan misses most, by how much, and that as a share of the target's extent."""
    error, each = tracking_error(task, run), []
    for names, what in weighed_groups(task):
        states = [task.model.state_names.index(name) for name in names]
        far = float(np.linalg.norm(error[:, states], axis=1).max())
        share = far / max(_extent(task, states), 1e-300)
        each.append((what, Quantity(far, task.model.states[names[0]]), share))
    return max(each, key=lambda one: one[2])


def rough(plan: Plan) -> Iterator[Finding]:
    """Inputs jump over half their [limits], or sensor noise moves them through the gains."""
    if plan.made is None:
        return
    task, gain = plan.task, plan.made.policy.gain
    times = jumps(plan.made.predicted_inputs, task.high - task.low)
    for name, often in zip(task.model.input_names, times.tolist(), strict=True):
        if often >= OFTEN:
            yield found("plan.rough", name, input=name, times=often)
    if gain is None or (times >= OFTEN).any():
        return
    noise = sensor_noise(plan.workspace.task_trials(), plan.workspace.base_model.n)
    parts = gain[:, :, : task.model.n] ** 2 * noise**2  # (H, m, n)
    pieces = np.array_split(parts, min(PIECES, len(parts)))  # gains grow towards an end
    each = np.sqrt([piece.sum(axis=2).mean(axis=0) for piece in pieces])  # (pieces, m)
    span, planned = task.high - task.low, np.ptp(plan.made.predicted_inputs, axis=0)
    allowed = np.where(np.isfinite(span), span, planned)
    for j, (name, unit) in enumerate(task.model.inputs.items()):
        most = int(np.argmax(each[:, j]))
        if each[most, j] > SHAKEN * allowed[j] > 0:
            state = task.model.state_names[int(np.argmax(pieces[most][:, j].mean(axis=0)))]
            shaken = Quantity(each[most, j], unit)
            yield found("plan.rough", name, input=name, shaken=shaken, state=state)


def unguarded(plan: Plan) -> Iterator[Finding]:
    """States leave [safety] that have no target, or no weight on it."""
    if plan.refused is None:
        return
    task, out = plan.task, leaving(plan)
    weight = task.reward.state + task.reward.terminal
    given, names = np.isfinite(task.target).any(axis=0), task.model.state_names
    if bare := [names[i] for i in np.flatnonzero(out & ~given)]:
        line, command = drawn(task), None
        to = [("--to", f"{name}={task.start[names.index(name)]:g}") for name in bare]
        if line is not None:
            again = NextCommand(
                line.verb, (*line.arguments, *(word for pair in to for word in pair))
            )
            command = rendered(again, plan.workspace.address)
        yield found("plan.unguarded", *bare, command=command)
    if free := [names[i] for i in np.flatnonzero(out & given & (weight == 0))]:
        yield found("plan.unguarded", *free, unweighed=1)


def leaving(plan: Plan) -> NDArray[np.bool_]:
    """Return which states leave [safety] in the refused plan, (n,) bool."""
    task = plan.task
    assert task.safety_low is not None and task.safety_high is not None
    assert plan.refused is not None
    states = plan.refused.predicted_states
    return np.asarray(((states < task.safety_low) | (states > task.safety_high)).any(axis=0))


def unused_rows(plan: Plan) -> Iterator[Finding]:
    """target.csv has more rows than the horizon."""
    name, used = str(plan.workspace.config.task.target), plan.task.horizon + 1
    rows = len(plan.workspace.read_target(plan.workspace.folder / name)[1])
    if rows > used:
        yield found("file.rows", name, rows=str(rows), used=used, weight=Weight.NOTE)


def not_at_rest(plan: Plan) -> Iterator[Finding]:
    """The robot is not at rest at its start, but would be under another input."""
    if one := held_before(plan.workspace, plan.again):
        yield one


def leaves_after_its_end(plan: Plan) -> Iterator[Finding]:
    """A line's plan leaves [safety] after its end: it can be drawn so that it ends at rest."""
    if plan.made is None or (rest := to_end_at_rest(plan.workspace, plan.made)) is None:
        return
    name = plan.made.id
    command = rendered(to_run(plan.workspace, name), plan.workspace.address)
    yield found("plan.draw_again", then=rest, candidate=name, command=command)


CHECKS: tuple[Callable[[Plan], Iterator[Finding]], ...] = (
    no_motion,
    no_limits,
    without_effect,
    limits_of_log,
    of_other_limits,
    off_target,
    rough,
    unguarded,
    unused_rows,
    not_at_rest,
    leaves_after_its_end,
)
