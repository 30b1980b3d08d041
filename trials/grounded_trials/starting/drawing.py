"""Draws a manoeuvre into a workspace: its columns, the weights that follow, and what is told."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from grounded.checks import refused, unknown
from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding, Quantity, Weight, found, settle
from grounded.frozen import Array
from grounded.places import velocities
from grounded.result import UNSAID, Document
from grounded_trials.logs.inspection.inspect_log import inspect_log
from grounded_trials.logs.log_paths import log_files
from grounded_trials.logs.log_table import LogMapping, log_mapping, read_log
from grounded_trials.starting.shapes import (
    PATHS,
    SHAPES,
    Drive,
    has_plane,
    in_steps,
    line_target,
    path_target,
    step_target,
)
from grounded_trials.store.own_files import TRIAL, format_of
from grounded_trials.store.trial_file import read_trial
from grounded_trials.wording import figure
from grounded_trials.workspace.candidates.at_rest import (
    rest_at_end,
    rest_of_trials,
)
from grounded_trials.workspace.candidates.handover import INSPECT, unmapped
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import unknown_trial
from grounded_trials.workspace.new_target import replace_target
from grounded_trials.workspace.off_target import driven
from grounded_trials.workspace.user_files.config import set_keys
from grounded_trials.workspace.user_files.task_file import read_target


def recorded_run(workspace: Folder, file: str) -> dict[str, Array]:
    """Return the states of a recorded run as a target.

    The file is a stored trial, t0001; a trial file; a log in any format; or a CSV with columns `t`
    and states. One that does not exist, or can't be sampled, is refused.
    """
    model, path = workspace.base_model, Path(file)
    if not path.exists():
        if file.lower() in workspace.discarded():
            raise unknown_trial(workspace, file)
        path = {one.id: one.path for one in workspace.store.list()}.get(file.lower(), path)
    if not path.exists():
        raise unknown("file or shape", file, SHAPES)
    if path.is_file() and format_of(path) == TRIAL:
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


SECONDS = 5.0  # default duration of a step
STRAIGHT = 1e3  # times its size: larger turning radii are those of a straight line

Weights = dict[str, dict[str, float]]  # by kind (state, terminal, input_change) and name


@dataclass(frozen=True)
class Manoeuvre:
    """A manoeuvre as a person asks for it."""

    shape: str  # one of `shapes.SHAPES`, a stored trial, or a file of a log or of columns
    drive: Drive = field(default_factory=Drive)  # size and pace of a path
    to: Mapping[str, float] = field(default_factory=dict)  # where states end, or what they keep
    seconds: float | None = None  # of a step or a line to a state; None: 5 s, or by the pace
    rest: bool = False  # whether the states that a line leaves free rest at its end

    @property
    def is_path(self) -> bool:
        """Whether it is driven along a path in the plane."""
        return self.shape in PATHS


@dataclass(frozen=True, eq=False, repr=False)
class Drawn(Document):
    """What was drawn."""

    path: Path = field(metadata={"key": "target"})  # the file of the target
    # lowest and highest value of the column of each tracked state
    ranges: Mapping[str, tuple[float, float]] = field(metadata={"key": "columns"})
    horizon: int  # number of control steps H
    units: Mapping[str, str] = field(metadata=UNSAID)  # of the model's states
    dt: float = field(metadata=UNSAID)  # control interval [s]
    free: tuple[str, ...]  # states without a column
    # highest speed [m/s] and smallest turning radius [m] of a path, NaN and inf if none
    driven: tuple[float, float] = field(metadata=UNSAID)
    weights: Weights = field(metadata=UNSAID)  # what is new in [reward]
    findings: tuple[Finding, ...]  # what is told, the heaviest first
    then: NextCommand = field(metadata=UNSAID)  # the command to type next


def draw(workspace: Folder, asked: Manoeuvre) -> Drawn:
    """Write a manoeuvre to the workspace's target, with its length and usual weights.

    Raises:
        GroundedError: if it can't be drawn for this model; the files are then as before.
    """
    # Where it begins: [task] start, or where the trials show the robot at rest.
    rest, seen = rest_of_trials(workspace)
    model, old = workspace.base_model, workspace.config.task
    start, before = old.start or rest, _reward(workspace)

    # Its columns, those of a log know their own start; and the files.
    columns = _columns(workspace, asked, start)
    extra: tuple[Any, ...] = ()
    rest = rest if asked.shape in SHAPES else {}
    line = asked.rest and asked.shape == "line"
    if line and (rests := rest_at_end(workspace, columns, start)) is not None:
        columns, extra = {**columns, **rests.columns}, (rests.weights, [*rests.columns])
    path = replace_target(workspace.config, columns, model, *extra)
    if rest:
        set_keys(workspace.config.file, "task", start=rest)
    workspace.forget()

    # What is told of it.
    reward = _reward(workspace)
    free = tuple(name for name in model.states if name not in columns)
    new = ", ".join(f"{name} = {figure(value)}" for name, value in rest.items())
    begun = [found("target.start", seen, start=new)] * bool(rest)
    planar = asked.is_path and has_plane(model)
    along = driven(model, columns, old.dt) if planar else (math.nan, math.inf)
    return Drawn(
        path,
        {name: (float(v.min()), float(v.max())) for name, v in columns.items()},
        len(next(iter(columns.values()))) - 1,
        model.states,
        old.dt,
        free,
        (along[0], along[1] if along[1] < STRAIGHT * asked.drive.size else math.inf),
        {kind: own for kind, own in reward.items() if own != before.get(kind, {})},
        settle(_told(workspace, asked, columns, reward, begun)),
        INSPECT if unmapped(workspace) else NextCommand("propose"),
    )


def _columns(workspace: Folder, asked: Manoeuvre, start: Mapping[str, float]) -> dict[str, Array]:
    """Return the columns of a manoeuvre, (H + 1,) each."""
    model, dt, shape = workspace.base_model, workspace.config.task.dt, asked.shape
    long = SECONDS if asked.seconds is None else asked.seconds
    if shape == "line" and (asked.to or not has_plane(model)):
        return line_target(asked.to, start, asked.drive, model, dt, asked.seconds)
    if shape == "step":
        return step_target(asked.to, model, dt, long, start)
    if asked.seconds is not None:
        raise GroundedError(found("given.either", "--seconds", shape, how="one"))
    if asked.is_path:
        return path_target(shape, asked.drive, model, dt, asked.to, start)
    return recorded_run(workspace, shape)


def _reward(workspace: Folder) -> Weights:
    written = tomllib.loads(workspace.config.file.read_text(encoding="utf-8"))
    return dict(written.get("reward", {}))


def _told(
    workspace: Folder,
    asked: Manoeuvre,
    columns: Mapping[str, Array],
    reward: Weights,
    begun: Sequence[Finding],
) -> Iterator[Finding]:
    """Yield what is told of a new target."""
    # States that are weighed although they are free.
    model, config = workspace.base_model, workspace.config
    kinds = (reward.get(kind, {}) for kind in ("state", "terminal"))
    weighed = {name for kind in kinds for name, weight in kind.items() if weight}
    if about := [name for name in model.states if name in weighed - {*columns}]:
        rates = velocities(model) if asked.shape == "line" else ()
        to = " ".join(f"--to {name}={'0' if name in rates else 'VALUE'}" for name in about)
        path = asked.is_path and not asked.to
        yield found("given.unweighed", *about, to=None if path else to, weight=Weight.WARN)

    # What is of the log it all began with.
    if config.seen_in:
        yield found("plan.limits_of_log", log=config.seen_in)
    if (lost := unmapped(workspace)) is not None:
        yield lost

    # Columns that leave [safety].
    bounds = config.safety.pairs(list(model.states))
    for name, column in columns.items():
        least, most = bounds.get(name, (-math.inf, math.inf))
        low, high = float(column.min()), float(column.max())
        if low < least or high > most:
            goes = Quantity(low if low < least else high, model.states[name])
            facts: dict[str, Any] = {"state": name, "value": goes, "low": least, "high": most}
            yield found("plan.outside", name, table="safety", weight=Weight.WARN, **facts)
    yield from begun
