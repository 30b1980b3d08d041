"""States that no sensor gives: by the smoother of `grounded.estimate`, never by bare differences.

    [estimate]
    measured = { x = 0.002, y = 0.002, psi = 0.005 }   # standard deviation of each measured state
    process = { v = 0.05 }                             # optional, a control step; else estimated

The measured states of [log] are filtered forth and back through the crude model, whose process
noise is estimated from the same log by maximum likelihood. Measured states stay as they
were measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from grounded.errors import GroundedError, nearest
from grounded.frozen import Array
from grounded.model import Model
from grounded_trials.logs.log_table import LogMapping, read_log
from grounded_trials.logs.resample import Gridded
from grounded_trials.toml_table import Table
from grounded_trials.workspace.folder import Folder


@dataclass(frozen=True)
class EstimateTable:
    """[estimate]: which states are measured, and how well."""

    measured: dict[str, float]
    process: dict[str, float]


def read_estimate(table: Table, model: Model) -> EstimateTable:
    """The checked [estimate] table.

    Raises:
        GroundedError: for an unknown state, or a standard deviation that is not positive.
    """
    found = EstimateTable(
        measured=table.numbers("measured", model.state_names),
        process=table.numbers("process", model.state_names),
    )
    table.finish()
    for kind, values in (("measured", found.measured), ("process", found.process)):
        for name, std in values.items():
            if std <= 0:
                raise table.error(f"{kind}.{name}", f"must be a positive deviation, found {std:g}")
    if not found.measured:
        raise table.error("measured", "names no state; give { x = 0.002, ... }")
    return found


def read_with_estimates(
    workspace: Folder, files: Sequence[Path], mapping: LogMapping, *, data: bool
) -> tuple[Gridded, tuple[str, ...]]:
    """A log with all the model's states, and the names of those that were estimated.

    Raises:
        GroundedError: if a measured state is not mapped, or the smoother fails on this log.
    """
    model, config = workspace.base_model, workspace.config
    table = read_estimate(config.estimate, model)
    measured = [name for name in model.state_names if name in table.measured]
    for name in measured:
        if name not in mapping.states:
            raise GroundedError(
                f"[estimate] measured '{name}' is not in [log.state]: "
                + nearest(name, mapping.states)
            )
    missing = [name for name in model.input_names if name not in mapping.inputs]
    if missing:
        raise GroundedError(f"[log] maps no input '{missing[0]}'")
    found = read_log(
        files,
        mapping,
        config.task.dt,
        states=measured,
        inputs=model.input_names,
        angles=model.angles,
        steps=None if data else config.task.horizon,
    )
    states = _smoothed(workspace, found, measured, table)
    estimated = tuple(name for name in model.state_names if name not in table.measured)
    return replace(found, states=states), estimated


def _smoothed(
    workspace: Folder, found: Gridded, measured: list[str], table: EstimateTable
) -> Array:
    """All states (T + 1, n): the smoother's, with the measured ones as they were measured."""
    from grounded.estimate import Noise, Record, noise_of, of_states, smooth_trials

    model, task = workspace.base_model, workspace.task
    dt = task.dt
    times = np.arange(len(found.states), dtype=np.float64) * dt
    record = Record(
        times=times,
        measured=found.states,
        command_times=times[:-1],
        commands=found.inputs,
        past=found.start_inputs,
    )
    measurement = of_states(model, measured)
    options = {"latency": task.latency, "measurement": measurement}
    noise = noise_of(model, [record], **options).noise  # type: ignore[arg-type]
    process = np.array(noise.process)
    for name, std in table.process.items():
        process[model.state_names.index(name)] = std
    known = np.array([table.measured[name] for name in measured])
    noise = Noise(process=process, measurement=known, dt=noise.dt)
    smooth = smooth_trials(model, [record], noise, **options)[0]  # type: ignore[arg-type]
    if not np.isfinite(smooth.states).all():
        raise GroundedError(
            f"the smoother finds no finite states for this log ({smooth.status}): the crude model "
            "is too far off to tell what was not measured; check its units and the [log] mapping"
        )
    states = np.array(smooth.states)
    for column, name in enumerate(measured):
        states[:, model.state_names.index(name)] = found.states[:, column]
    return states
