"""Writes the first grounded.toml of a workspace made from a log, and its target.csv."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from grounded.frozen import Array
from grounded.model import Model
from grounded.trial import Trial
from grounded_trials.starting import template
from grounded_trials.starting.shapes import has_plane
from grounded_trials.store.store import write_atomically
from grounded_trials.toml_table import key
from grounded_trials.workspace.candidates.at_rest import standstill
from grounded_trials.workspace.off_target import usual_weights
from grounded_trials.workspace.user_files.config import FILE, OFFERED
from grounded_trials.workspace.user_files.task_file import change_weight, write_target

SEEN = """# SEEN in the log, 0 included: enter those of your robot, then delete these two lines
seen_in = {log}"""


def number(value: float) -> str:
    """Return a number as TOML."""
    return repr(round(float(value), 12))


def inline(values: Mapping[str, float]) -> str:
    """Return numbers by name as an inline table."""
    inside = ", ".join(f"{key(name)} = {number(value)}" for name, value in values.items())
    return f"{{ {inside} }}" if inside else "{ }"


def write_first(
    folder: Path,
    model: Model,
    dt: float,
    columns: Mapping[str, Array],
    ranges: Mapping[str, tuple[float, float] | None],
    table: str,
    why: str,
    log: str,
    held: Mapping[str, float],
) -> None:
    """Write grounded.toml and target.csv.

    `columns` are those of the target; `ranges` the lowest and highest value of each signal in the
    log, in the model's unit; `table` is the text of [log]; `why` says why this kind of robot was
    chosen; `held` are the states in which the robot stood at the start of the log, and the inputs
    that held it there.
    """
    write_target(folder / "target.csv", dt, dict(columns))
    weights = usual_weights(model, columns)
    changes = {name: change_weight(ranges[name], model.inputs[name]) for name in model.input_names}
    stated = getattr(model.step, "limits", {})  # limits in an MJCF or URDF file
    late = getattr(model.step, "latency", {})  # of an MJCF file's actuators
    limits = [
        f"{key(name)} = {_span(found)}"
        + f"  # the model's file says {_span(stated.get(name, ()))}" * (name in stated)
        for name in model.input_names
        if (found := ranges[name]) is not None and found[0] < found[1]
    ]
    if limits:
        limits.append(SEEN.format(log=json.dumps(log, ensure_ascii=False)))
    offered = {name: OFFERED * weight for name, weight in weights.items()}
    state, terminal, change = map(_short, (weights, offered, changes))
    weighed = template("weights.toml").rstrip()
    text = template(FILE).format(
        title=f"made from a log by `grounded init --from` ({why})",
        model="",
        dt=number(dt),
        horizon=len(next(iter(columns.values()))) - 1,
        start=_short(held),
        feedback="true",
        latency=_short(late),
        weights=weighed.format(state=state, terminal=terminal, changes=change),
        limits="\n".join(limits) or "# those of your robot",
        search="",
        rest=table.rstrip(),
    )
    write_atomically(folder / FILE, text.encode())


def held_first(
    model: Model, columns: Mapping[str, Array], sent: Mapping[str, Array], dt: float
) -> dict[str, float]:
    """Return the states in which a robot stands at the start of a log, and the inputs holding it.

    {} if it moves, and for one that drives in a plane without an input: it may start anywhere.
    """
    if set(sent) != set(model.inputs) or set(columns) != set(model.states):
        return {}
    x = np.column_stack([columns[name] for name in model.state_names])
    u = np.column_stack([sent[name] for name in model.input_names])
    stand = standstill(model, Trial(x, u, dt, model.state_names, model.input_names))
    if stand is None or not any(unit.endswith("/s") for unit in model.states.values()):
        return {}
    inputs = zip(model.input_names, stand.inputs.tolist(), stand.needs, strict=True)
    held = {name: u for name, u, needed in inputs if needed}
    where = zip(model.states.items(), stand.states.tolist(), stand.steady, strict=True)
    away = {n: x for (n, unit), x, near in where if not unit.endswith("/s") and abs(x) > near}
    return away | held if held or not has_plane(model) else {}


def _span(ends: Sequence[float]) -> str:
    return f"[{', '.join(f'{end:.6g}' for end in ends)}]"


def _short(values: Mapping[str, float]) -> str:
    return inline({name: float(f"{value:.6g}") for name, value in values.items()})
