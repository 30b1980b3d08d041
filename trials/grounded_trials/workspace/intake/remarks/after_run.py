"""Warn of what the robot did after its run: it left [safety], or did not stay at its target.

[reward] only judges the run. After it the runner sends the input that was held before the start. If
that input does not hold the robot at its target (an arm against its weight, a hover), only another
controller does. If it would, the robot arrived in motion: then the target and the weights of the
rates are to be changed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from grounded.findings import Finding, Quantity, found
from grounded.frozen import Array
from grounded.model import Model
from grounded.search.planner import Planner
from grounded.search.safety import coasting
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.wording import with_unit
from grounded_trials.workspace.off_target import (
    rates_among,
    reaches,
    weighed_groups,
)

AWAY = 0.02  # drift after a run, relative to the target's extent, above which it is reported
DEAR = 0.2  # of the run's cost: what its end would cost more where the robot came to be after it
SURE = 3.0  # standard deviations of the noise by which the farthest of some samples is off
SETTLED = 5.0  # [s] for which an input is held until the memory of effects has settled
CAUSED = 0.5  # share of the drift that the model must predict from rest, under the input held
GROWS = 1.5  # of a push, not of a speed: the second half of the drift exceeds the first by this
FASTER = 2.0  # and the drift exceeds by this what the speed at the end gives


def _drifted(
    task: Task, name: str, what: str, far: float, near: float, steps: int
) -> dict[str, Any]:
    """Return how far what was, and when, as facts."""
    unit = task.model.states[name]
    later, then = Quantity(float(far), unit), Quantity(float(near), unit)
    return {"what": what, "far": later, "near": then, "after": Quantity(steps * task.dt, "s")}


def moved_on(planner: Planner, whole: Trial) -> Finding | None:
    """Return that a robot that was to reach a point drifts away from it after the run, or None.

    Only if the inputs are constant after the run, so that nobody drove it. What counts is how far
    the first group of states moved, and what the end of the run would cost more where any group
    came to be: late commands of its last steps turned a docked robot by 0.5 degrees.
    """
    task = planner.task
    end, last = task.horizon, whole.finite_steps
    groups = weighed_groups(task) if reaches(task) else []
    held = whole.inputs[end:last]
    if not groups or last <= end + 1 or np.ptp(held[1:], axis=0).any():
        return None
    cost = DEAR * -task.utility(whole.until(end))
    for k, rate in enumerate(rates_among(task, groups)):
        states = [task.model.state_names.index(name) for name in groups[k][0]]
        off, way = _from_target(task, whole.states[: last + 1], states)
        far, dear = np.linalg.norm(off, axis=1), off**2 @ task.reward.terminal[states]
        worst = end + int(np.argmax(far[end:]))
        surely = far[worst] - SURE * np.linalg.norm(whole.noise()[states])  # one of many samples
        away = not k and surely > max(AWAY * way, 2 * far[end])
        more = 0.0 if rate else dear[worst] - dear[end]
        if away or (surely > 2 * far[end] and more > cost):
            break
    else:
        return None
    names, what = groups[k]
    facts = _drifted(task, names[0], what, far[worst], far[end], worst - end)
    if away and let_go(planner, whole, states, worst - end, off[worst] - off[end]):
        sent, would = _told(task.model, held[-1]), _to_hold(planner, whole)
        return found("run.let_go", *names, held=sent, would=would, **facts)
    return found("run.moved_on", *names, **facts)


def _from_target(task: Task, run: Array, states: Sequence[int]) -> tuple[Array, float]:
    """Return how far states (T, n) are off the end of the target, (T, k), and its extent."""
    off = task.model.difference(run, task.target[-1])[:, states]
    extent = np.ptp(np.vstack([task.start, task.target])[:, states], axis=0)
    return off, float(np.linalg.norm(extent))


def let_go(planner: Planner, whole: Trial, states: Sequence[int], steps: int, drift: Array) -> bool:
    """Return whether the input sent after a run does not hold the robot where the run ended.

    Either the model predicts most of the drift although the robot rests at the end of the run and
    the effects' memory has settled. Or the log shows a push: the drift grows ever faster, and is
    more than the speed at the end explains.

    Args:
        planner: the task, and the model with adopted effects.
        whole: the run with the seconds that follow it, under a constant input.
        states: indices of the position that drifted.
        steps: steps from the end of the run until it was farthest off.
        drift: how far it had moved by then, (len(states),).
    """
    task, end = planner.task, planner.task.horizon
    size = float(np.linalg.norm(drift))
    settled = _at_rest(planner, whole)
    with np.errstate(all="ignore"):
        after = coasting(planner.plan, settled, whole.inputs[end + 1])[: steps + 1, : task.model.n]
    moved = task.model.difference(after, after[:1])[:, states]
    if len(moved) and float(np.linalg.norm(moved, axis=1).max()) > CAUSED * size:
        return True
    path = task.model.difference(whole.states[end : end + steps + 1], whole.states[end])[:, states]
    along = path @ drift / size
    before = max(1, min(steps, end, 4))
    speed = task.model.difference(whole.states[end], whole.states[end - before])[states]
    coasts = abs(float(speed @ drift / size)) / before * steps
    half = float(along[len(along) // 2])
    return bool(steps > 3 and size - half > GROWS * half and size > FASTER * coasts)


def _at_rest(planner: Planner, whole: Trial) -> Trial:
    """Return the robot at rest where a run ended, under the input that was sent after it."""
    from grounded.places import integrals

    task, end = planner.task, planner.task.horizon
    x, u = whole.states[end].copy(), whole.inputs[end + 1]
    x[[one.j for one in integrals(task.model) if one.exact]] = 0.0
    steps = math.ceil(SETTLED / task.dt)
    states, inputs = np.tile(x, (steps + 1, 1)), np.tile(u, (steps, 1))
    return planner.lift(replace(whole, states=states, inputs=inputs, start_inputs=u))


def _to_hold(planner: Planner, whole: Trial) -> tuple[str, ...]:
    """Return the constant input that would hold the robot where its run ended; () if unknown."""
    from grounded_trials.workspace.candidates.at_rest import resting

    model, memory = planner.task.model, np.arange(planner.plan.model.n) >= planner.task.model.n
    rest = _at_rest(planner, whole)
    there = replace(
        planner.plan, start=rest.states[-1], past=whole.inputs[planner.task.horizon + 1]
    )
    with np.errstate(all="ignore"):
        own = resting(there, memory, replace(planner.loose, start=there.start, past=there.past))
    return () if own is None else _told(model, own[len(memory) :], 2)


def _told(model: Model, inputs: Array, digits: int = 3) -> tuple[str, ...]:
    """Return the inputs (m,) as `force = 0 N` and `steer = 0.1 rad`."""
    pairs = zip(model.inputs.items(), inputs + 0.0, strict=True)
    return tuple(with_unit(f"{name} = {v:.{digits}g}", unit) for (name, unit), v in pairs)


def left_afterwards(task: Task, whole: Trial) -> Finding | None:
    """Return that the robot left [safety] after a run that stayed inside, or None."""
    assert task.safety_low is not None and task.safety_high is not None
    states = whole.states[: whole.finite_steps + 1]
    out = np.maximum(task.safety_low - states, states - task.safety_high)
    if (out[: task.horizon + 1] > 0).any() or not (out > 0).any():
        return None
    t, i = np.unravel_index(int(np.argmax(out)), out.shape)
    first = int(np.argmax((out > 0).any(axis=1))) - task.horizon
    name, unit = list(task.model.states.items())[int(i)]
    most = float(states[t, i])
    bound = Quantity(float(np.clip(most, task.safety_low[i], task.safety_high[i])), unit)
    after = Quantity(first * whole.dt, "s")
    return found("run.after_safety", name, after=after, bound=bound, most=Quantity(most, unit))
