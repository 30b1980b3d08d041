"""Find where the robot rests: the input that holds it at its start, and its start by its logs.

Without a start, a step or a path would begin at zero: a plate at 0 degC in a room of 23 degC. Only
states whose value the physics depends on are read off a log (a temperature, an angle under
gravity). A position that may be anywhere is for the user to choose.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import rate_states
from grounded.search.first_guess import trim
from grounded.search.noise import sensor_noise
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.off_target import SMALLEST_RANGE, usual_weights
from grounded_trials.workspace.user_files.config import OFFERED

if TYPE_CHECKING:
    from numpy.typing import NDArray

STOOD = 0.5  # [s] at the start of a trial in which the robot may stand still
LEAST_STEPS = 3  # of it
STEADY = 0.05  # fraction of a signal's range (or a rate's maximum) that counts as standing still


@dataclass(frozen=True, eq=False)
class Stand:
    """Where a robot stood at the start of a trial."""

    states: Array  # (n,) their medians in the second half of that time
    inputs: Array  # (m,) the same: a controller may sag at first
    steady: Array  # (n,) changes of the states that count as none
    # (m,) inputs that hold it there: constant, or beyond what trembles. An input without which the
    # model moves less is none: a throttle held while the motors are off.
    needs: NDArray[np.bool_]
    trial: str  # its id


def standstill(model: Model, trial: Trial) -> Stand | None:
    """Return where the robot stands at the start of a trial; None if it moves there."""
    steps = max(LEAST_STEPS, round(STOOD / trial.dt))
    x, u = trial.states[: steps + 1], trial.inputs[:steps]
    if trial.steps <= steps or not (np.isfinite(x).all() and np.isfinite(u).all()):
        return None
    low, high = (
        np.nan_to_num(np.concatenate([end(v, axis=0) for v in (trial.states, trial.inputs)]))
        for end in (np.fmin.reduce, np.fmax.reduce)
    )
    whole, sent, n = (high - low)[: model.n], (high - low)[model.n :], model.n
    rates = np.array([unit.endswith("/s") for unit in model.states.values()])
    off, later = drift(x), u[steps // 2 :]
    off, whole = (
        np.where(rates, a, b)
        for a, b in ((x.mean(axis=0), off), (np.maximum(abs(low), abs(high))[:n], whole))
    )
    if (np.abs(off) > STEADY * whole).any() or not steady(later, sent).all():
        return None
    at, held = np.median(x[steps // 2 :], axis=0), np.median(later, axis=0)
    needs = (held != 0) & ((np.ptp(later, axis=0) == 0) | (np.abs(held) > STEADY * sent))

    # By how much the model moves there with all inputs, and without each, in parts of the ranges.
    u = held * np.append(np.ones((1, model.m)), 1 - np.eye(model.m), axis=0)
    x = np.tile(at, (len(u), 1))
    moves = np.zeros(len(u))
    with suppress(GroundedError), np.errstate(all="ignore"):  # a faulty model tells of none
        moved = model.difference(model.system.step(x, u, model.values, trial.dt), x)
        moves = np.linalg.norm(moved / np.where(whole > 0, whole, 1.0), axis=1)
    needs &= moves[1:] >= moves[0]
    return Stand(at, held, STEADY * whole, needs, trial.id)


def steady(sent: Array, span: Array | float) -> Array:
    """Return whether inputs (T,) or (T, m) neither drift nor scatter by more than `STEADY`.

    The scatter is judged by its rms: a controller that holds a robot answers the noise of its
    sensors, so that commands tremble by several times that around what holds it.
    """
    most = STEADY * np.asarray(span)
    return np.asarray((np.abs(drift(sent)) <= most) & (sent.std(axis=0) <= most))


def drift(values: Array) -> Array:
    """Return the change from first to last of the straight line through values (T,) or (T, n)."""
    steps = len(values)
    if steps < 2:
        return np.zeros(values.shape[1:])
    t = np.arange(steps) - (steps - 1) / 2
    return np.asarray(np.tensordot(t, values, axes=1) / (t**2).sum() * (steps - 1))


# the robot is at rest if it moves less than this share of the motion as configured
AT_REST_SHARE = 1e-3
BEGUN = (0.0, 1.0, -1.0)  # offsets tried: a thrust that is squared has zero slope at 0
STILL = 1e-9  # motion in a step, in a state's unit, that counts as none
DEPENDS = 1e-9  # change of a step per unit of a state, above which the physics depends on it


def resting(task: Task, loose: Task | None = None) -> Array | None:
    """Return the inputs (m,) inside the limits under which the robot rests at its start.

    None if it rests under those held before already, or if the start is in motion. `loose` is the
    task with softened dry friction: with sticking friction it would rest under almost any input.
    """
    away = np.abs(moved_at_start(task, task.past)).max()
    if away <= STILL:
        return None
    still, every = np.tile(task.start, (2, 1)), np.ones(task.model.n, dtype=bool)
    middle, inside = task.past.copy(), np.isfinite(task.high - task.low)
    middle[inside] = 0.5 * (task.low[inside] + task.high[inside])
    for first in [*(task.past + move for move in BEGUN), middle]:
        u = np.clip(first, task.low, task.high)
        for one in (loose or task, replace(task, smoothing=0.0)):  # a kink at 0, once near the rest
            one = replace(one, target=still, input_target=None, past=u)
            u = np.asarray(trim(one, still, every)[1][0])
            if (np.abs(moved_at_start(task, u)) <= AT_REST_SHARE * away).all():
                return u
    return None


def moved_at_start(task: Task, inputs: Array) -> Array:
    """Return by how much the state changes in the first step under an input, (n,)."""
    problem = task.problem(exact=True)
    with np.errstate(all="ignore"):
        after = problem.system.step(task.start[None], inputs[None], problem.p, problem.dt)[0]
    return task.model.difference(after, task.start)


def rest_of_trials(workspace: Folder) -> tuple[dict[str, float], str]:
    """Return the values for [task] start by the first stored trial that begins at rest; its id.

    Inputs that hold it are included; ({}, "") if [task] start has values, or no trial tells.
    """
    try:
        trials = [] if workspace.config.task.start else workspace.task_trials()
    except GroundedError:  # a damaged file, which other commands report
        trials = []
    for trial in trials:
        stand = standstill(workspace.base_model, trial)
        if stand and (found := _rest_of(workspace, stand)):
            return found, stand.trial
    return {}, ""


def _rest_of(workspace: Folder, stand: Stand) -> dict[str, float]:
    """Return the states in which a robot rests at the start of a trial, and the inputs holding it.

    Empty if it rests where all of these are zero.
    """
    model, dt = workspace.base_model, workspace.config.task.dt
    at, held = stand.states, stand.inputs
    rates = np.array([unit.endswith("/s") for unit in model.states.values()])
    a = model.system.linearise(at[None], held[None], model.values, dt)[0][0]
    needed = np.abs(np.nan_to_num(a) - np.eye(model.n)).max(axis=0) > DEPENDS
    told = needed & ~rates & (np.abs(at) > stand.steady)
    found = {n: float(f"{at[i]:.4g}") for i, n in enumerate(model.state_names) if told[i]}
    inputs = {n: float(f"{held[j]:.4g}") for j, n in enumerate(model.input_names) if stand.needs[j]}
    return found | (inputs if found else {})


NOISY = 0.02  # most utility that the noise of a state may cost at the end, by its weight


@dataclass(frozen=True, eq=False)
class Rest:
    """What makes the free states of a line rest at its end."""

    columns: dict[str, Array]  # of these and their rates, (H + 1,); they count at the end only
    # for [reward] terminal, also of the line's states: a fast ball leaves a level beam as well
    weights: dict[str, float]


def rest_at_end(
    workspace: Folder, columns: Mapping[str, Array], start: Mapping[str, float]
) -> Rest | None:
    """Return columns and weights for the free states of a line; None if it leaves none free.

    These are the states that have a rate, with it; if none has one, the first. They rest at 0.
    """
    model = workspace.base_model
    rates, free = rate_states(model), [name for name in model.states if name not in columns]
    if not free:
        return None
    rows, found, ranges = len(next(iter(columns.values()))), dict[str, Array](), {}
    for name in [name for name in free if name in rates] or free[:1]:
        begins = start.get(name, 0.0)
        found[name] = np.linspace(begins, 0.0, rows)
        ranges[name] = np.linspace(min(begins, -SMALLEST_RANGE), 0.0, rows)
        if (rate := rates.get(name)) is not None and rate not in columns:
            found[rate], ranges[rate] = np.zeros(rows), ranges[name]  # only for its usual weight
    usual = usual_weights(model, {**columns, **ranges})
    weights = {name: OFFERED * weight for name, weight in usual.items()}
    each = sensor_noise(workspace.task_trials(), model.n)
    for name, noise in zip(model.state_names, each.tolist(), strict=True):
        if name in found and weights[name] * noise**2 > NOISY:
            weights[name] = NOISY / noise**2
    return Rest(found, {name: float(f"{w:.6g}") for name, w in weights.items()})
