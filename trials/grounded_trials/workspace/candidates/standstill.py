"""Find where the robot stood still in the first rows of a trial, before it was driven.

Its inputs need not be what held it there: a finger may have kept a ball on a beam that is not
level. If the logs show it at the start that a plan assumes, the start is right although the model
would move from there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded.model import Model
from grounded.trial import Trial
from grounded_trials.workspace.folder import Folder

STOOD = 0.5  # [s] at the start of a log in which the robot may stand still
LEAST = 3  # steps of it
STEADY = 0.05  # fraction of a signal's range (or a rate's maximum) that counts as standing still
SAME = 0.25  # of the distance between two starts: within it of one of them, a robot stood there
LESS = 0.5  # of the motion that the model predicts: if it moved less, something held it


@dataclass(frozen=True, eq=False)
class Stand:
    """Where a robot stood at the start of a trial.

    Args:
        states: their medians (n,).
        inputs: their medians (m,).
        moved: the drift of the states in that time (n,).
        seconds: how long it stood there at least.
        ranges: of the inputs in the whole trial (m,).
        trial: its id.
    """

    states: Array
    inputs: Array
    moved: Array
    seconds: float
    ranges: Array
    trial: str


def standstill(model: Model, trial: Trial) -> Stand | None:
    """Return where the robot stands at the start of a trial; None if it moves there."""
    steps = max(LEAST, round(STOOD / trial.dt))
    x, u = trial.states[: steps + 1], trial.inputs[:steps]
    if trial.steps <= steps or not (np.isfinite(x).all() and np.isfinite(u).all()):
        return None
    whole, sent = np.nan_to_num(np.ptp(trial.states, axis=0)), np.ptp(trial.inputs, axis=0)
    rates = np.array([unit.endswith("/s") for unit in model.states.values()])
    fastest, moved = np.abs(trial.states).max(axis=0), drift(x)
    off = np.where(rates, np.abs(x.mean(axis=0)), np.abs(moved))
    most = np.where(rates, fastest, whole)
    if (off > STEADY * most).any() or not steady(u, sent).all():
        return None
    at, held = np.median(x, axis=0), np.median(u, axis=0)
    return Stand(at, held, moved, steps * trial.dt, sent, trial.id)


def standstills(workspace: Folder) -> list[Stand]:
    """Return where the robot stood at the start of the stored trials that begin at a standstill."""
    try:
        trials = workspace.task_trials()
    except GroundedError:  # a damaged file, which other commands report
        return []
    model = workspace.base_model
    return [stand for trial in trials if (stand := standstill(model, trial))]


def held_there(workspace: Folder, given: Array, rests: Array, rate: Array) -> bool:
    """Return whether by the stored logs something other than its inputs holds a robot at its start.

    They show it standing there, under the same inputs, although the model would move. Logs in which
    it stands elsewhere say that nothing holds it.

    Args:
        workspace: the workspace with the logs.
        given: states and inputs that the plan assumes before its start (n + m,).
        rests: those under which the model rests (n + m,); other inputs count as no such start.
        rate: change of the states per second, by the model, from `given` (n,).
    """
    model, n = workspace.base_model, workspace.base_model.n
    other, k = model.difference(rests[:n], given[:n]), int(np.argmax(np.abs(rate)))
    if not np.array_equal(rests[n:], given[n:]):
        return False
    alike = [
        one
        for one in standstills(workspace)
        if (np.abs(one.inputs - given[n:]) <= STEADY * one.ranges).all()
    ]
    return bool(alike) and all(
        (np.abs(model.difference(one.states, given[:n])) <= SAME * np.abs(other))[other != 0].all()
        and abs(one.moved[k]) < LESS * abs(rate[k]) * one.seconds
        for one in alike
    )


def read_at_start(workspace: Folder, name: str, bias: float) -> str:
    """Return the trial in whose first rows a sensor with a bias reads what [task] start has; or "".

    A start that was measured by the sensor is right as it is. A trial in which the robot stands
    with another reading contradicts it.

    Args:
        workspace: the workspace with the logs.
        name: the state.
        bias: of its sensor, in the state's unit.
    """
    i, start = workspace.base_model.state_names.index(name), workspace.task.start
    found = standstills(workspace)
    off = [abs(float(one.states[i] - start[i])) for one in found]
    return found[0].trial if found and max(off) <= SAME * abs(bias) else ""


def steady(sent: Array, span: Array | float) -> Array:
    """Return whether inputs (T,) or (T, m) neither drift nor scatter by more than `STEADY`.

    The scatter is judged by its rms: a controller that holds a robot answers the noise of its
    sensors, so that commands tremble by several times that around what holds it.

    Args:
        sent: the inputs.
        span: their range in the whole log.
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
