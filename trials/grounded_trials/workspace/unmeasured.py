"""States that no sensor gives: by the smoother of `grounded.estimate`, never by bare differences.

    [estimate]
    measured = { x = 0.002, y = 0.002, psi = 0.005 }   # standard deviation of each measured state
    process = { v = 0.05 }                             # optional, a control step; else estimated

The measured states of [log] are filtered forth and back through the crude model, whose process
noise is estimated from the same log by maximum likelihood. Measured states stay as they
were measured.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from grounded.errors import GroundedError
from grounded.model import Model
from grounded_trials.logs.resample import Gridded
from grounded_trials.toml_table import Table
from grounded_trials.workspace.folder import Folder


@dataclass(frozen=True)
class EstimateTable:
    """[estimate]: which states are measured, and how well."""

    measured: dict[str, float]
    process: dict[str, float]


def read_estimate(table: Table, model: Model) -> EstimateTable:
    """The checked [estimate] table, what is measured in the model's order.

    Raises:
        GroundedError: for an unknown state, or a standard deviation that is not positive.
    """
    measured = table.numbers("measured", model.state_names)
    process = table.numbers("process", model.state_names)
    table.finish()
    for kind, values in (("measured", measured), ("process", process)):
        for name, std in values.items():
            if std <= 0:
                raise table.error(f"{kind}.{name}", f"must be a positive deviation, found {std:g}")
    if not measured:
        raise table.error("measured", "names no state; give { x = 0.002, ... }")
    ordered = {name: measured[name] for name in model.state_names if name in measured}
    return EstimateTable(ordered, process)


def smoothed(workspace: Folder, found: Gridded, table: EstimateTable) -> Gridded:
    """A log of the measured states with all states: the smoother's, the measured ones as they are.

    Raises:
        GroundedError: if the smoother fails on this log.
    """
    from grounded.estimate import NoiseStd, Record, noise_of, of_states, smooth_trials

    model, task = workspace.base_model, workspace.task
    measured, dt = list(table.measured), task.dt
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
    known = np.array(list(table.measured.values()))
    noise = NoiseStd(process=process, measurement=known, dt=noise.dt)
    smooth = smooth_trials(model, [record], noise, **options)[0]  # type: ignore[arg-type]
    if not np.isfinite(smooth.states).all():
        raise GroundedError(
            f"the smoother finds no finite states for this log ({smooth.status}): the crude model "
            "is too far off to tell what was not measured; check its units and the [log] mapping"
        )
    states = np.array(smooth.states)
    for column, name in enumerate(measured):
        states[:, model.state_names.index(name)] = found.states[:, column]
    return replace(found, states=states)
