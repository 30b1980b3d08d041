"""Where a robot rests as its logs begin: the [task] start of a workspace in which nobody set it.

Without a start, a step or a path would begin at zero: a plate at 0 degC in a room of 23 degC. Only
states whose value the physics depends on are read off a log (a temperature, an angle under
gravity). A position that may be anywhere is for the user to choose.
"""

from __future__ import annotations

import numpy as np

from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded.model import Model
from grounded.trial import Trial
from grounded_trials.workspace.folder import Folder

STOOD = 0.5  # [s] at the start of a log in which the robot may stand still
LEAST = 3  # steps of it
STILL = 0.05  # fraction of a signal's range (or a rate's maximum) that counts as standing still
DEPENDS = 1e-9  # change of a step per unit of a state, above which the physics depends on it


def rest_of_trials(workspace: Folder) -> tuple[dict[str, float], str]:
    """Return where the robot rests at the start of the first stored trial that begins at rest.

    Returns:
        The values for [task] start that are not zero, inputs that hold it included, and the trial;
        ({}, "") if [task] start has values, or no trial tells.
    """
    if workspace.config.task.start:
        return {}, ""
    try:
        trials = workspace.task_trials()
    except GroundedError:  # a damaged file, which other commands report
        return {}, ""
    for trial in trials:
        if found := resting(workspace.base_model, trial):
            return found, trial.id
    return {}, ""


def resting(model: Model, trial: Trial) -> dict[str, float]:
    """Return the states in which a robot rests at the start of a trial, and the inputs holding it.

    Empty if it moves there, or rests where all of these are zero.
    """
    steps = max(LEAST, round(STOOD / trial.dt))
    x, u = trial.states[: steps + 1], trial.inputs[:steps]
    if trial.steps <= steps or not (np.isfinite(x).all() and np.isfinite(u).all()):
        return {}
    whole, sent = np.nan_to_num(np.ptp(trial.states, axis=0)), np.ptp(trial.inputs, axis=0)
    rates = np.array([unit.endswith("/s") for unit in model.states.values()])
    fastest = np.abs(trial.states).max(axis=0)
    off = np.where(rates, np.abs(x.mean(axis=0)), np.abs(drift(x)))
    most = np.where(rates, fastest, whole)
    if (off > STILL * most).any() or not steady(u, sent).all():
        return {}
    at, held = np.median(x, axis=0), np.median(u, axis=0)
    a = model.system.linearise(at[None], held[None], model.values, trial.dt)[0][0]
    needed = np.abs(np.nan_to_num(a) - np.eye(model.n)).max(axis=0) > DEPENDS
    told = needed & ~rates & (np.abs(at) > STILL * whole)
    found = {n: float(f"{at[i]:.4g}") for i, n in enumerate(model.state_names) if told[i]}
    inputs = {n: float(f"{held[j]:.4g}") for j, n in enumerate(model.input_names)}
    return found | {n: v for n, v in inputs.items() if found and v}


def steady(sent: Array, span: Array | float) -> Array:
    """Return whether inputs (T,) or (T, m) neither drift nor scatter by more than `STILL`.

    The scatter is judged by its rms: a controller that holds a robot answers the noise of its
    sensors, so that commands tremble by several times that around what holds it.

    Args:
        sent: the inputs.
        span: their range in the whole log.
    """
    most = STILL * np.asarray(span)
    return np.asarray((np.abs(drift(sent)) <= most) & (sent.std(axis=0) <= most))


def drift(values: Array) -> Array:
    """Return the change from first to last of the straight line through values (T,) or (T, n)."""
    steps = len(values)
    if steps < 2:
        return np.zeros(values.shape[1:])
    t = np.arange(steps) - (steps - 1) / 2
    return np.asarray(np.tensordot(t, values, axes=1) / (t**2).sum() * (steps - 1))
