"""Build the Task of the method from grounded.toml, target.csv and a loaded model.

target.csv has the desired states, one row per control step; a state without a column is free.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Collection, Mapping
from dataclasses import replace
from io import TextIOWrapper
from pathlib import Path

import numpy as np

from grounded.checks import known, one_of, refused, wrong
from grounded.errors import GroundedError, NextCommand
from grounded.frozen import Array
from grounded.model import Model
from grounded.task import MAX_HORIZON, Task
from grounded.utility import Reward
from grounded_trials.plain_file import open_file, unreadable
from grounded_trials.store.store import write_atomically
from grounded_trials.toml_table import Table
from grounded_trials.workspace.user_files.config import Config


def build_task(config: Config, model: Model, folder: Path) -> Task:
    """Build the task that the files describe."""
    try:
        return _build(config, model, folder)
    except GroundedError as error:
        raise error.at(config.file.name, unless="file") from None


def check_tables(config: Config, model: Model, rows: int) -> None:
    """Check all of grounded.toml that a task is built from, whatever its target will be."""
    untracked = replace(config, task=replace(config.task, target="", horizon=rows - 1))
    build_task(untracked, model, config.file.parent)


def _build(config: Config, model: Model, folder: Path) -> Task:
    states, inputs = list(model.state_names), list(model.input_names)
    table = config.task
    known("state or input", table.start, [*states, *inputs], "the model", "[task] start")
    known("input", table.latency, inputs, "the model", "[task] latency")
    path = folder / table.target
    if not path.resolve().is_relative_to(folder.resolve()):
        raise wrong("[task] target", table.target, must="inside")
    if table.target:
        target, input_target = target_arrays(path, states, inputs, table.dt, table.horizon)
    else:
        target, input_target = np.full((table.horizon + 1, len(states)), np.nan), None
    first = np.where(np.isfinite(target[0]), target[0], 0.0)
    start = _by_name(table.start, states, first)
    low, high = _ends(config.limits, inputs)
    safe_low, safe_high = _ends(config.safety, states)
    held = np.zeros(len(inputs)) if input_target is None else input_target[0]
    aimed = np.clip(held, low, high)  # default of the input held before a run
    past = _by_name(table.start, inputs, aimed)
    return Task(
        model=model,
        dt=table.dt,
        target=target,
        reward=_reward(config, states, inputs),
        start=start,
        past=past,
        low=low,
        high=high,
        feedback=table.feedback,
        latency=_by_name(table.latency, inputs, np.zeros(len(inputs))),
        input_target=input_target,
        safety_low=safe_low,
        safety_high=safe_high,
        smoothing=config.model.smoothing,
    )


def _by_name(given: Mapping[str, float], names: list[str], others: Array) -> Array:
    """Return a value for each name, of those that are given or of the others."""
    found = np.array(others, float)
    for name, value in given.items():
        if name in names:
            found[names.index(name)] = value
    return found


def _ends(table: Table, names: list[str]) -> tuple[Array, Array]:
    """Return the lower and upper limits of each name; infinite where none is given."""
    low, high = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    for name, ends in table.pairs(names).items():
        low[names.index(name)], high[names.index(name)] = ends
    return low, high


def _reward(config: Config, states: list[str], inputs: list[str]) -> Reward:
    table = config.reward
    kinds = {"state": states, "terminal": states, "input": inputs, "input_change": inputs}
    table.expect(kinds)
    weights = {}
    for kind, names in kinds.items():
        weights[kind] = _by_name(table.sub(kind).numbers(names), names, np.zeros(len(names)))
    reward = Reward(**weights)
    if not config.task.target:  # nothing to follow: weights on errors have no meaning
        none = np.zeros(len(states))
        return replace(reward, state=none, terminal=none)
    if not (reward.state.any() or reward.terminal.any()):
        raise refused("plan.no_weight", state=states[0])
    return reward


SHAPE = NextCommand("target", ("SHAPE",))
ROW_LIMIT = MAX_HORIZON + 2  # of target.csv; a longer one is not read to its end
FULL = {"%": (-100.0, 100.0)}  # range assumed for an input without limits, by unit
CHANGE = 0.01  # weight on the changes of an input with range -1 to 1
CHANGES = 4 * CHANGE


def read_target(path: Path, free: Collection[str] = ()) -> tuple[list[str], Array]:
    """Read the names of the columns (`t` first) and their values, (rows, columns).

    Columns of inputs, beside the states of a run, are `free` to hold NaN.
    """
    try:
        with TextIOWrapper(open_file(path), encoding="utf-8-sig", newline="") as stream:
            reader = csv.reader(stream)
            names = [*map(str.strip, next(reader, []))]
            if not names:
                raise refused("file.rows", path.name, rows="no", needs=2, target=1, then=SHAPE)
            one_of(f"the first column of {path.name}", names[0], ["t"])
            if len({*names}) < len(names):
                raise refused("given.twice", path.name, name=max(names, key=names.count))
            rows: list[list[float]] = []
            for line, row in enumerate(reader, start=2):
                if len(rows) > ROW_LIMIT:
                    raise unreadable(path.name, f"> {ROW_LIMIT} rows")
                if not "".join(row).strip():
                    continue
                if len(row) != len(names):
                    sizes = {"line": line, "has": len(row), "names": len(names)}
                    raise refused("file.row", path.name, **sizes)
                rows.append(_numbers(f"{path.name} line {line}", names, row, free))
    except FileNotFoundError:
        raise refused("file.missing", path, where="[task] target") from None
    except IsADirectoryError:
        raise unreadable(path, "folder", where="[task] target") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise unreadable(path, error, kind="CSV") from None
    return names, np.array(rows, dtype=float).reshape(len(rows), len(names))


def _numbers(where: str, names: list[str], row: list[str], free: Collection[str]) -> list[float]:
    found = list[float]()
    for name, cell in zip(names, row, strict=True):
        try:
            found.append(float(cell))
        except ValueError:
            raise wrong(f"{where}: '{name}'", cell, must="number") from None
        if not (name in free or math.isfinite(found[-1])):
            raise wrong(f"{where}: '{name}'", cell, must="finite", do="omit")
    return found


def target_arrays(
    path: Path, states: list[str], inputs: list[str], dt: float, horizon: int
) -> tuple[Array, Array | None]:
    """Return the target (H + 1, n), NaN where free, and the inputs' target (H, m) or None."""
    names, values = read_target(path)
    known("state or input", names[1:], [*states, *inputs], "the model", path.name)
    there = str(len(values))
    if len(values) < 2:
        raise refused("file.rows", path.name, rows=there, needs=2, target=1, then=SHAPE)
    if len(values) < horizon + 1:
        sizes = {"rows": there, "needs": horizon + 1, "horizon": len(values) - 1}
        raise refused("file.rows", path.name, **sizes)
    t, at = values[: horizon + 1, 0], values[0, 0] + dt * np.arange(horizon + 1)
    for i in np.flatnonzero(np.abs(t - at) > 0.01 * dt)[:1]:
        each = float(values[-1, 0] - values[0, 0]) / (len(values) - 1)
        facts = {"each": each, "sample": f"of line {i + 2}", "at": t[i], "expected": at[i]}
        then = NextCommand("target", (str(path),))
        raise refused("file.grid", path.name, then=then, dt=dt, **facts)
    given = dict(zip(names[1:], values[: horizon + 1, 1:].T, strict=True))
    nothing = np.full(horizon + 1, np.nan)
    target = np.stack([given.get(name, nothing) for name in states], axis=1)
    if given.keys().isdisjoint(inputs):
        return target, None
    columns = [given.get(name, np.zeros(horizon + 1))[:horizon] for name in inputs]
    return target, np.stack(columns, axis=1)


def limited_changes(config: Config, model: Model) -> dict[str, tuple[float, float]]:
    """Return the weights on changes of inputs with [limits]: (ignoring the limits, using them)."""
    limits = config.limits.pairs(model.input_names)
    return {
        name: (change_weight(None, unit), float(f"{change_weight(limits[name], unit):.4g}"))
        for name, unit in model.inputs.items()
        if name in limits
    }


def change_weight(limits: tuple[float, float] | None, unit: str) -> float:
    """Return the default weight on an input's changes, by its range, or by its unit."""
    low, high = limits or FULL.get(unit, (-1.0, 1.0))
    return CHANGES / (high - low) ** 2 if high > low else CHANGE


def write_target(path: Path, dt: float, columns: dict[str, Array]) -> None:
    """Write a target file, see `target_text`."""
    write_atomically(path, target_text(dt, columns).encode())


def target_text(dt: float, columns: dict[str, Array]) -> str:
    """Format a target as CSV."""
    H = len(next(iter(columns.values())))
    lines = [",".join(["t", *columns])]
    for i in range(H):
        at = (round(float(values[i]), 12) + 0.0 for values in columns.values())  # no -0
        row = [f"{i * dt:.10g}", *(f"{value:.9g}" for value in at)]
        lines.append(",".join(row))
    return "\n".join(lines) + "\n"
