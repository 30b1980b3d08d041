"""How far runs are off their target, in the units of the states.

The states of a position count as one distance. States that [reward] weighs along the way are
reported by their rms and largest error; those weighed at the end, or to be reached, by their error
at the end.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grounded.findings import Finding, Quantity, found
from grounded.frozen import Array
from grounded.model import Model
from grounded.result import Document, or_zero
from grounded.task import Task
from grounded.trial import Trial

# groups of states reported beside the one that costs most: positions and angles before their
# rates, then by cost
GROUPS_TOLD = 2
EXACT = 1e-4  # share of the largest error below which a plan's end is on target
RATES = ("speed", "heading_rate", "rates")  # roles of velocities
# of the highest speed: below it a path's radius is not computed from its samples
SPEED_OF_RADIUS = 0.5
SMALLEST_RANGE = 0.1  # smallest range of a target column used for its weight
# a column counts as constant if its range is below STILL_SHARE of its size (of SMALLEST_RANGE if
# that is less), or below HARDLY in its unit
STILL_SHARE, HARDLY = 0.01, 1e-4
RATE = 0.1  # weight of a velocity beside its position, relative to that of other states
NARROW = 0.2  # smallest range used for a position's axis, as a fraction of the largest one
UNKNOWN = 1.0  # range assumed for a constant column if no column of its unit moves
DEAREST = itemgetter(1)
REST = 0.1  # a target is at rest if its last step is below this fraction of its mean step


@dataclass(frozen=True, eq=False, repr=False)
class OffTarget(Document):
    """The error of one state, or of the position as one distance, over all runs of a candidate."""

    what: str  # the state, or "position"
    unit: str
    rms: float = float("nan")  # over the whole run; NaN if only its end is weighed
    most: float = float("nan")  # the largest error
    at_s: float = float("nan")  # when that was, in seconds of the run
    # rms of the errors at the last state; NaN if a run ended early, or if the end has no weight of
    # its own and nothing is to be reached (see `reaches`)
    end: float = float("nan")
    noise: float = 0.0  # std of a single sample, below which an error at the end says nothing

    @property
    def finding(self) -> Finding:
        """The errors as `run.off_target`; an end on target, or within noise, says so."""
        size, told = partial(Quantity, unit=self.unit), dict[str, Any]()
        if np.isfinite(self.rms):
            told |= {"rms": size(self.rms), "most": size(self.most), "at": f"{self.at_s:.4g}"}
        if np.isfinite(self.end):
            at_end = 0.0 if self.end < EXACT * self.most else self.end  # of a plan
            if at_end < self.noise:
                told |= {"noise": size(self.noise)}
            else:
                told |= {"end": size(at_end)} if at_end else {"there": 1}
            told |= {"also": int("rms" in told)}
        return found("run.off_target", self.what, **told)


def off_target_of(task: Task, trials: Sequence[Trial]) -> tuple[OffTarget, ...]:
    """Return how far the runs of one candidate are off the target, the position first.

    That are the errors of the groups that matter most; () if nothing is tracked. Runs may end
    early, or have no known state at all.
    """
    if not trials:
        return ()
    model, reward = task.model, task.reward
    found, costs = list[OffTarget](), list[tuple[bool, float, int]]()
    errors, at, noise = list[Array](), list[NDArray[np.intp]](), list[Array]()
    for trial in trials:
        run = trial.whole(task.horizon)
        errors.append(tracking_error(task, run.until(max(run.finite_steps, 0))))
        at.append(np.arange(len(errors[-1])))
        noise.append(run.noise(run.finite_steps + 1))
    every, step, shaken = (
        np.concatenate(errors),
        np.concatenate(at),
        np.sqrt(np.mean(np.square(noise), axis=0)),
    )
    ends = every[np.append(step[1:] == 0, True)]  # the last state of each run
    ended = len(every) < len(errors) * (task.horizon + 1)
    groups = weighed_groups(task)
    units = {model.states[names[0]] for names, _ in groups}
    for names, what in groups:
        unit = model.states[names[0]]
        states = np.isin(model.state_names, names)
        far, end = np.linalg.norm(every[:, states], axis=1), ends[:, states]
        if not np.isfinite(far).all():
            continue
        running, terminal = reward.state[states], reward.terminal[states]
        cost = float((every[:, states] ** 2 @ running).sum() + (end**2 @ terminal).sum())
        values = {"noise": float(np.linalg.norm(shaken[states]))}
        if running.any() or ended:
            values |= {"rms": float(np.sqrt(np.mean(far**2))), "most": float(far.max())}
            values["at_s"] = task.dt * int(step[np.argmax(far)])
        if (terminal.any() or reaches(task, groups)) and not ended:
            values["end"] = float(np.sqrt((end**2).sum() / len(end)))
        size = float(np.abs(task.target[:, states]).max())  # that the errors are differences of
        for key in {*values} - {"at_s"}:
            values[key] = or_zero(values[key], size)
        rate = unit[-2:] == "/s" and unit[:-2] in units  # of another group
        found.append(OffTarget(what.removeprefix("the "), unit, **values))
        costs.append((rate, -cost, len(found) - 1))
    told = {*sorted(costs)[:GROUPS_TOLD], *sorted(costs, key=DEAREST)[:1]}
    return tuple(one for one, cost in zip(found, costs, strict=True) if cost in told)


def reaches(task: Task, groups: Sequence[tuple[list[str], str]]) -> bool:
    """Return whether the task is to reach a point: its first weighed group is to end at rest."""
    states = np.isin(task.model.state_names, groups[0][0])
    way = task.model.difference(np.vstack([task.start, task.target]), task.start)[:, states]
    steps = np.linalg.norm(np.diff(way, axis=0), axis=1)
    return bool(steps.any() and steps[-1] <= REST * steps.mean())


def weighed_groups(task: Task) -> list[tuple[list[str], str]]:
    """Return the weighed states with a target, in groups, each with the name of its error.

    The axes of a position form one group, which comes first.
    """
    names, known = task.model.state_names, np.asarray(np.isfinite(task.target).all(axis=0))
    weighed = known & ((task.reward.state != 0) | (task.reward.terminal != 0))
    axes, found = np.array(position_axes(task.model), int), list[tuple[list[str], str]]()
    axes = axes[known[axes]]
    if len(axes) > 1:
        found.append((np.array(names)[axes].tolist(), "the position"))
        weighed[axes] = False
    for i in np.flatnonzero(weighed):
        found.append(([names[i]], names[i]))
    return found


def position_axes(model: Model) -> list[int]:
    """Return the indices of the two or three states that are a position in space; [] if none."""
    roles = roles_of(model)
    axes = roles.get("position", [])[:3]
    if len(axes) < 2:
        return []
    up = roles.get("altitude", [])  # (x, z) may have it already
    return axes + up[: 3 - len(axes)] if {*up}.isdisjoint(axes) else axes


def position_names(model: Model) -> list[str]:
    """Return the names of the states in `position_axes`."""
    return [model.state_names[i] for i in position_axes(model)]


def rates_beside(model: Model, names: Collection[str]) -> set[str]:
    """Return which of some states are the velocities of others, or of a position among them."""
    from grounded.places import rate_states

    known = {model.state_names[i] for role in RATES for i in roles_of(model).get(role, ())}
    moved = {rate for place, rate in rate_states(model).items() if place in names}
    return {*names} & (moved | (known if {*position_names(model)} & {*names} else set()))


def usual_weights(model: Model, columns: Mapping[str, Array]) -> dict[str, float]:
    """Return the weights on a target's states that nobody chose: an error of its range costs 1.

    That of a velocity beside its position costs RATE: its noise is a larger part of its range, and
    a plan would leave the path for the sake of the speed. The axes of a position share the smallest
    range, of at least NARROW of the largest. A constant column gets the largest range or size among
    the columns of its unit (a y that is constant while x moves; a step to a constant 5 m), or
    UNKNOWN if none of them moves or is larger than UNKNOWN.
    """
    rates, position = rates_beside(model, columns), position_names(model)
    ranges = {name: _range_of(values) for name, values in columns.items()}
    if axes := [own for name, own in ranges.items() if name in position and own > 0]:
        narrow = max(min(axes), NARROW * max(axes))
        ranges |= {name: narrow for name in ranges if name in position}
    units, size, told = model.states, dict[str, float](), set[str]()  # by unit: which tell an error
    for name, own in ranges.items():
        unit, most = units.get(name, ""), float(np.abs(columns[name]).max())
        size[unit] = max(size.get(unit, 0.0), own or most)
        told |= {unit} if own or most > UNKNOWN else set()
    weights = dict[str, float]()
    for name, own in ranges.items():
        unit = units.get(name, "")
        width = own or (size[unit] if unit in told else UNKNOWN)
        weights[name] = (RATE if name in rates else 1.0) * max(width, SMALLEST_RANGE) ** -2
    return weights


def _range_of(values: Array) -> float:
    """Return the range of a target column, 0 if it hardly moves (from 0.02591 to 0.0259 rad)."""
    own, size = float(np.ptp(values)), min(float(np.abs(values).max()), SMALLEST_RANGE)
    return own if own > max(STILL_SHARE * size, HARDLY) else 0.0


def driven(model: Model, columns: Mapping[str, Array], dt: float) -> tuple[float, float]:
    """Return the highest speed [m/s] and the smallest turning radius [m] of a path in a plane."""
    x, y = (columns[name] for name in model.roles["position"][:2])
    v = np.diff(np.stack([x, y]), axis=1) / dt
    speed = np.hypot(*v)
    turn = v[0, :-1] * v[1, 1:] - v[1, :-1] * v[0, 1:]  # speed^2 times the sine of the turn
    both, mean = speed[:-1] * speed[1:], (speed[:-1] + speed[1:]) / 2
    fast = np.minimum(speed[:-1], speed[1:]) > SPEED_OF_RADIUS * speed.max()
    rate = np.arcsin(np.clip(turn[fast] / both[fast], -1, 1)) / dt
    with np.errstate(divide="ignore"):
        radius = mean[fast] / np.abs(rate)
    return float(speed.max()), float(radius.min(initial=math.inf))


def roles_of(model: Model) -> dict[str, list[int]]:
    """Return the indices of the states in each role of the model."""
    found = dict[str, list[int]]()
    for role, names in model.roles.items():
        some = (names,) if isinstance(names, str) else names
        found[role] = [*map(model.state_names.index, filter(model.states.__contains__, some))]
    return found


def tracked(task: Task) -> list[int]:
    """Return the indices of the states that have a target."""
    return [i for i in range(task.model.n) if np.isfinite(task.target[:, i]).all()]


def asked_for(task: Task) -> list[int]:
    """Return the indices of the states that have a target and a weight, of the way or of the end.

    A column of target.csv without a weight is where the path would take that state, not a wish.
    """
    weights = task.reward.state + task.reward.terminal
    return [i for i in tracked(task) if weights[i] > 0]


def tracking_error(task: Task, trial: Trial) -> Array:
    """Return s_t - target_t, (T + 1, n), with angles wrapped; NaN where there is no target."""
    return task.model.difference(trial.states, task.target[: trial.steps + 1])
