"""Creates a workspace from a model file alone, for a robot that no example resembles.

Every setting of the task has a placeholder value that runs: the target holds each state at its
start with weight 1, which is zero; if the range of a joint excludes zero, all joints start in the
middle of their ranges. Inputs have the limits of the MJCF or URDF file, or none. If some input
holds the model there (a quadrotor's hover), that is the input before the start. `drive.py` is the
robot's program: it reads the candidate and writes the trial; the user implements `measure` and
`send`.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from grounded.errors import GroundedError
from grounded.findings import Finding, found
from grounded.frozen import Array
from grounded.model import Model
from grounded.task import Task
from grounded.utility import Reward
from grounded_trials.starting import template
from grounded_trials.starting.examples import fresh_folder, toml_of
from grounded_trials.starting.own_model import own_model
from grounded_trials.store.store import write_atomically
from grounded_trials.workspace.candidates.at_rest import resting
from grounded_trials.workspace.user_files.config import DRIVE, FILE, UNWRITTEN
from grounded_trials.workspace.user_files.task_file import change_weight, write_target

DT, HORIZON = 0.05, 100  # [s], steps
COMMAND = 'command = "python drive.py {candidate} {trial}"   # or by hand: propose, drive, ingest'
CHANGES = "# for inputs from -1 to 1: `target` updates it from the limits until you change it"


def write_blank(folder: Path, file: str | Path, dt: float | None = None) -> None:
    """Write a workspace for a model file; never overwrites a file.

    Args:
        folder: the workspace to create.
        file: a Python file that defines `model`, or an MJCF or URDF file; see `own_model`.
        dt: control interval [s]; None: 0.05.

    Raises:
        GroundedError: if the file holds no model, if its copy does not load, or if the folder
            already holds a workspace.
    """
    own = own_model(file)
    with fresh_folder(folder, (FILE, "target.csv", DRIVE, *own.missing(folder))):
        model = own.bring(folder)
        task = _task(model, dt or DT)
        columns = {name: task.target[:, i] for i, name in enumerate(model.state_names)}
        write_target(folder / "target.csv", task.dt, columns)
        told = {"states": dict(model.states), "inputs": dict(model.inputs), "left": UNWRITTEN}
        write_atomically(folder / DRIVE, template(DRIVE).format(**told).encode())
        name = f"{model.name or own.file.stem}: set your own target, weights and limits"
        text = toml_of(task, name, COMMAND, explicit=True)
        text = text.replace("\ninput_change", f"\n{CHANGES}\ninput_change")
        write_atomically(folder / FILE, text.encode())


def left_open(model: Model) -> list[Finding]:
    """Return what the file of a model made different from what its user may expect."""
    without = getattr(model.step, "without", ())
    beside = [name for name, at in zip(model.state_names, _start(model), strict=True) if at]
    told = [found("start.unmoved", *without)] if without else []
    return told + ([found("start.outside", *beside)] if beside else [])


def _start(model: Model) -> Array:
    """Return the state (n,) at which the model starts, see the module."""
    ranges = getattr(model.step, "ranges", {})  # in an MJCF or URDF file
    low, high = np.array([ranges.get(name, (0.0, 0.0)) for name in model.state_names]).T
    outside = bool(((low > 0) | (high < 0)).any())
    return np.asarray(0.5 * (low + high) * outside)


def _task(model: Model, dt: float) -> Task:
    """Return the task of holding the start for 100 steps, from the inputs that do so."""
    n, m, start = model.n, model.m, _start(model)
    stated = getattr(model.step, "limits", {})  # limits in an MJCF or URDF file
    ends = [stated.get(name, (-np.inf, np.inf)) for name in model.input_names]
    changes = np.array([change_weight(None, unit) for unit in model.inputs.values()])
    low, high = np.array(ends).T
    task = Task(
        model=model,
        dt=dt,
        target=np.tile(start, (HORIZON + 1, 1)),
        reward=Reward(np.ones(n), np.zeros(n), np.zeros(m), changes),
        start=start,
        past=np.clip(np.zeros(m), low, high),
        low=low,
        high=high,
    )
    with suppress(GroundedError):  # a faulty model is reported when planning
        if (held := resting(task)) is not None:
            return replace(task, past=np.array([float(f"{u:.6g}") for u in held]))
    return task
