"""The target of a workspace: whether it was drawn yet, and another one in its place."""

from __future__ import annotations

import math
import re
import tomllib
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
from grounded_trials.workspace.user_files.config import OFFERED, Config, as_toml, put
from grounded_trials.workspace.user_files.task_file import (
    check_tables,
    limited_changes,
    read_target,
    write_target,
)

PROPOSE = NextCommand("propose")
TARGET = NextCommand("target", ("SHAPE",))
MADE = re.compile(r"(?m)^# input_change = \{.*\}$")
OFFER = re.compile(r"(?m)^# terminal = \{.*\}$")


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
    check_tables(config, model, len(next(iter(columns.values()))))
    name = config.task.target or "target.csv"
    path = config.file.parent / name
    given, old = dict[str, Array](), None
    if path.is_file():
        try:
            old = path.read_bytes()
        except OSError as error:
            raise unreadable(path, error) from None
        with suppress(GroundedError, ValueError):  # an unreadable target is replaced
            names, values = read_target(path)
            given = dict(zip(names[1:], values.T[1:], strict=True)) if len(values) else {}
        write_atomically(path.with_name(path.name + ".bak"), old)
        write_atomically(config.file.with_name(config.file.name + ".bak"), config.file.read_bytes())
    write_target(path, config.task.dt, columns)
    try:
        set_target(config, model, columns, given, terminal, only_at_end)
    except BaseException:
        if old is None:
            path.unlink(missing_ok=True)
        else:
            write_atomically(path, old)
        raise
    return path


def set_target(
    config: Config,
    model: Model,
    columns: Mapping[str, Array],
    given: Mapping[str, Array],
    terminal: Mapping[str, float],
    only_at_end: Collection[str],
) -> None:
    """Write [task] target and horizon, and the weights of [reward] not chosen by the user.

    [reward] state counts as not chosen if it is empty, has the usual weights of the target before
    (`given`), or is 1 for each of its states (as `init --blank` writes it). In that case [reward]
    input_change is replaced too, for the inputs whose weight is still what `init` wrote.
    """
    import tomlkit

    each = usual_weights(model, columns)  # of ranges such as 1800 mm
    weights = {name: float(f"{w:.6g}") for name, w in each.items() if name not in only_at_end}
    text = config.file.read_text(encoding="utf-8-sig")
    document, made, new = tomlkit.parse(text), made_changes(text), dict[str, Any]()
    reward, blank = document.get("reward", {}), dict[str, float]()
    own, ends, written = (dict(reward.get(k, {})) for k in ("state", "terminal", "input_change"))

    # weights that nobody chose are renewed, and with them those that were offered for the end
    before_it = usual_weights(model, given) if given else {}
    usual = {k: w for k, w in before_it.items() if k in own or k not in ends}
    alike = (one for one in (usual, dict.fromkeys(usual, 1.0)) if _alike(own, one))
    before = next(alike, None)
    if before is not None or not (own or ends):
        was = usual if before is None else before
        offered = {k for k, w in ends.items() if k in was and _near(w, OFFERED * was[k])}
        ends = {
            k: OFFERED * weights[k] if k in weights and k in offered else w
            for k, w in ends.items()
            if k in own or k in columns or k not in given
        }
        for name, (without, with_limits) in limited_changes(config, model).items():
            if written.get(name, math.nan) in (without, made.get(name)):
                blank[name] = with_limits
        new = {"state": weights, "input_change": written | blank if blank else None}
    ends = {k: float(f"{w:.6g}") for k, w in (dict(terminal) | ends).items()}
    if ends != dict(reward.get("terminal", {})):
        new["terminal"] = ends
    rows = len(next(iter(columns.values())))
    put(document, "task", {"target": config.task.target or "target.csv", "horizon": rows - 1})
    put(document, "reward", new)
    text = tomlkit.dumps(document)

    # the comments that say what was offered, and what was written
    if before and own:
        offer = {name: float(f"{OFFERED * w:.6g}") for name, w in weights.items()}
        text = OFFER.sub(f"# terminal = {as_toml(offer).as_string()}", text)
    if made and blank:
        text = MADE.sub(f"# input_change = {as_toml(made | blank).as_string()}", text)
    write_atomically(config.file, text.encode())


def made_changes(text: str) -> dict[str, float]:
    """Return the `input_change` weights that `init --from` or `target` wrote, by their comment."""
    found = MADE.search(text)
    with suppress(tomllib.TOMLDecodeError):
        weights = tomllib.loads(found[0].removeprefix("# "))["input_change"] if found else {}
        return {name: w for name, w in weights.items() if isinstance(w, int | float)}
    return {}


def _alike(own: Mapping[str, float], weights: Mapping[str, float]) -> bool:
    return own.keys() == weights.keys() and all(_near(own[k], w) for k, w in weights.items())


def _near(one: float, weight: float) -> bool:
    return abs(one - weight) <= 1e-3 * abs(weight)


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
