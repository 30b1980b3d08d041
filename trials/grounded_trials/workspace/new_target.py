"""The target of a workspace: whether it was drawn yet, and another one in its place."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from grounded.checks import numbers, unknown, wrong
from grounded.errors import GroundedError, NextCommand
from grounded.frozen import Array
from grounded.model import Model
from grounded.task import MAX_HORIZON
from grounded_trials.plain_file import unreadable
from grounded_trials.store.store import write_atomically
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.off_target import usual_weights
from grounded_trials.workspace.user_files.config import Config, set_target
from grounded_trials.workspace.user_files.task_file import (
    check_tables,
    limited_changes,
    read_target,
    write_target,
)

PROPOSE = NextCommand("propose")
TARGET = NextCommand("target", ("SHAPE",))


def to_plan(workspace: Folder) -> NextCommand:
    """Return `propose`, or `target` if no candidate was made and no manoeuvre was drawn yet."""
    return TARGET if undrawn(workspace) else PROPOSE


def undrawn(workspace: Folder) -> bool:
    """Return whether no candidate was made and no manoeuvre was drawn since `init`.

    That wrote the run in a log, whose range [limits] still has, or zeros, with a start at zero.
    """
    task = workspace.config.task
    with suppress(GroundedError):  # `propose` reports an unreadable target
        drawn = not task.target or (workspace.folder / f"{task.target}.bak").exists()
        if drawn or workspace.candidate_ids():
            return False
        asks = np.nan_to_num(workspace.task.target).any() or any(task.start.values())
        return bool(workspace.config.seen_in) or not asks
    return False


def replace_target(
    config: Config,
    columns: Mapping[str, Array],
    model: Model,
    terminal: Mapping[str, float] = MappingProxyType({}),
    only_at_end: Collection[str] = (),
) -> Path:
    """Write target.csv, and its length and weights to grounded.toml, see `Workspace.target`.

    Both files are kept as they were, with `.bak` behind their names.
    """
    columns = checked(columns, model)
    rows = len(next(iter(columns.values())))
    check_tables(config, model, rows)
    each = usual_weights(model, columns)  # of ranges such as 1800 mm
    weights = {name: float(f"{w:.6g}") for name, w in each.items() if name not in only_at_end}
    name = config.task.target or "target.csv"
    path = config.file.parent / name
    usual, given, old = dict[str, float](), dict[str, Array](), None
    if path.is_file():
        try:
            old = path.read_bytes()
        except OSError as error:
            raise unreadable(path, error) from None
        with suppress(GroundedError, ValueError):  # an unreadable target is replaced
            names, values = read_target(path)
            given = dict(zip(names[1:], values.T[1:], strict=True))
            usual = usual_weights(model, given)
        write_atomically(path.with_name(path.name + ".bak"), old)
        write_atomically(config.file.with_name(config.file.name + ".bak"), config.file.read_bytes())
    write_target(path, config.task.dt, columns)
    try:
        set_target(
            config.file,
            name,
            rows - 1,
            weights,
            usual,
            limited_changes(config, model),
            terminal,
            [one for one in given if one not in columns],
        )
    except BaseException:
        if old is None:
            path.unlink(missing_ok=True)
        else:
            write_atomically(path, old)
        raise
    return path


def checked(columns: Any, model: Model) -> dict[str, Array]:
    """Return the columns of a target as arrays of equal length, (H + 1,)."""
    if not isinstance(columns, Mapping) or not columns:
        like = f"{{'{model.state_names[0]}': numpy.linspace(0, 1, 101)}}"
        raise wrong("the columns of a target", columns, must="dict", like=like)
    found: dict[str, Array] = {}
    for name, given in columns.items():
        if name not in model.states:
            raise unknown("state", name, model.state_names, "the model, for the target,")
        what = f"target: column '{name}'"
        values = numbers(given, what)
        if values.ndim != 1:
            raise wrong(what, values.shape, shape="(H + 1,)", do="rows")
        for row in np.flatnonzero(~np.isfinite(values)):
            raise wrong(what, got=f"{values[row]:g} in row {row}", must="finite", do="omit")
        found[str(name)] = values
    rows = {name: len(values) for name, values in found.items()}
    if len({*rows.values()}) > 1:
        raise wrong("the columns of a target", rows, must="even")
    count = next(iter(rows.values()))
    if not 2 <= count <= MAX_HORIZON + 1:
        raise wrong("the rows of a target", count, low=2, high=MAX_HORIZON + 1, do="rows")
    return found
