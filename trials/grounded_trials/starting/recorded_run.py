"""Reads a recorded run as a target: a stored trial, a log that [log] maps, or a table of states."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from grounded.checks import refused, unknown
from grounded.errors import NextCommand
from grounded.frozen import Array
from grounded_trials.logs.inspection.inspect_log import inspect_log
from grounded_trials.logs.log_files import kind_of, log_files
from grounded_trials.logs.log_table import LogMapping, log_mapping, read_log
from grounded_trials.starting.shapes import in_steps
from grounded_trials.store.own_files import TRIAL
from grounded_trials.store.trial_file import read_trial
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.unknown_id import refuse_ids, unknown_trial
from grounded_trials.workspace.user_files.task_file import read_target


def recorded_run(workspace: Folder, file: str, shapes: Sequence[str]) -> dict[str, Array]:
    """Return the states of a recorded run as a target.

    Args:
        workspace: provides the model, [log] and the stored trials.
        file: a stored trial, t0001; a trial file; a log in any format; or a CSV with columns `t`
            and states.
        shapes: names of the shapes, suggested if the file does not exist.

    Raises:
        GroundedError: if there is no such file, or it can't be sampled.
    """
    model, path = workspace.base_model, Path(file)
    if not path.exists():
        if file.lower() in workspace.discarded():
            raise unknown_trial(workspace, file)
        stored = {one.id: one.path for one in workspace.store.list()}
        path = stored.get(file.lower(), path)
    if not path.exists():
        refuse_ids(workspace, file, "target")
        raise unknown("file or shape", file, shapes)
    if path.is_file() and kind_of(path) == TRIAL:
        trial, _, _ = read_trial(path)
        trial = trial.until(max(trial.finite_steps, 0))
        times = trial.dt * np.arange(trial.steps + 1.0)
        return _sampled(workspace, file, times, [*trial.state_names], trial.states)
    mapping = log_mapping(workspace.config.log, model.state_names, model.input_names)
    if path.suffix == ".csv" and (mapping is None or not _holds(path, mapping)):
        names, values = read_target(path, free=model.input_names)
        return _sampled(workspace, file, values[:, 0] - values[0, 0], names[1:], values[:, 1:])
    if mapping is None:
        raise refused("file.no_mapping", file, then=NextCommand("inspect", (file,)))
    found = read_log(log_files(file), mapping, workspace.config.task.dt, angles=model.angles)
    return dict(zip(mapping.states, found.states.T, strict=True))


def _sampled(
    workspace: Folder, file: str, times: Array, names: list[str], values: Array
) -> dict[str, Array]:
    """Return the columns of the model's states, sampled every control interval from 0 on."""
    dt, states = workspace.config.task.dt, workspace.base_model.states
    known = [name for name in names if name in states]
    if not known:
        raise refused("given.fit", file, what="columns", theirs=tuple(names), own=tuple(states))
    rows = in_steps(times[-1], dt, np.floor((times[-1] + 1e-9) / dt)) + 1
    t = dt * np.arange(rows)
    return {name: np.interp(t, times, values[:, names.index(name)]) for name in known}


def _holds(table: Path, mapping: LogMapping) -> bool:
    """Return whether a table has all states and inputs of [log]: then it is a log, no target."""
    known = {f.path for f in inspect_log(table).numbers}
    return all(s.path in known for s in (*mapping.states.values(), *mapping.inputs.values()))
