"""The first grounded.toml of a workspace that is made from a log, and its target.csv."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from grounded.frozen import Array
from grounded.model import Model
from grounded_trials.store.store import write_atomically
from grounded_trials.toml_table import key
from grounded_trials.workspace.config import FILE, OFFERED
from grounded_trials.workspace.off_target import position_names
from grounded_trials.workspace.task_file import change_weight, equal_weights, write_target

STOOD = 0.5  # [s] at the begin of a log
STILL = 0.05  # of how far, or how fast, a state goes later in the log: it stands


def write_first(
    folder: Path,
    model: Model,
    grid: tuple[float, str],
    columns: Mapping[str, Array],
    horizon: int,
    ranges: Mapping[str, tuple[float, float] | None],
    table: str,
    why: str,
    log: str,
    held: Mapping[str, float],
) -> None:
    """Writes both.

    Args:
        folder: of the workspace.
        model: its crude model.
        grid: control interval [s], and what to say of it.
        columns: of the target, by state.
        horizon: steps.
        ranges: lowest and highest value of each signal in the log, in the model's unit.
        table: [log], as text.
        why: what says which kind of robot it is.
        log: the file's name.
        held: where the robot stood at the log's begin, and the inputs that held it; may be {}.
    """
    dt, whose = grid
    write_target(folder / "target.csv", dt, dict(columns))
    weights = equal_weights(columns, model.states, position_names(model))
    changes = {name: change_weight(ranges[name], model.inputs[name]) for name in model.input_names}
    stated = getattr(model.step, "limits", {})  # in a simulator's file
    limits = [
        f"{key(name)} = {_span(found)}"
        + f"  # the model's file says {_span(stated.get(name, ()))}" * (name in stated)
        for name in model.input_names
        if (found := ranges[name]) is not None and found[0] < found[1]
    ]
    lines = [
        f"# made from a log by `grounded init --from` ({why})",
        "",
        "[model]",
        'file = "model.py"             # the crude model' + ", plain NumPy" * (model.step is None),
        "",
        "[task]",
        f"dt = {dt:g}                     # [s] control interval{whose}",
        f"horizon = {horizon}                 # steps",
        'target = "target.csv"         # `grounded target` draws another; no column: free',
        f"start = {_inline(held) if held else '{ }'}"
        + "  # what held it where it stood in the log's first rows" * bool(held),
        "feedback = true               # false: open loop",
        "latency = { }                 # [s] transport delay of inputs: `fit --latency` finds it",
        "",
        "[reward]                      # quadratic weights: 1 / (range in the target)^2; `target`",
        "                              # sets them anew until you change one; of a column that",
        "                              # is constant: the largest of its unit, else 1",
        f"state = {_inline(weights)}",
        "# terminal, of the last step alone: where the run is to END at rest on its target",
        "# (docking, parking) and overshoots, 10 to 100 times state, the speeds' too",
        f"# terminal = {_inline({name: OFFERED * weight for name, weight in weights.items()})}",
        "# of (a_t - a_{t-1})^2: 0.04 / (range of [limits])^2, 0.01 of an input from -1 to 1",
        "# `target` sets it anew by [limits] until you change a weight; by those seen in the log:",
        f"# input_change = {_inline(changes)}",
        f"input_change = {_inline(changes)}",
        "",
        "[limits]" + "                      # put in what your robot may get" * (not limits),
        *limits,
        *[
            "# SEEN in the log: put in what your robot may get, then delete these two lines",
            f"seen_in = {json.dumps(log, ensure_ascii=False)}",
        ]
        * bool(limits),
        "",
        "[search]",
        "max_trials = 40",
        "",
        table.rstrip(),
        "",
    ]
    write_atomically(folder / FILE, "\n".join(lines).encode())


def held_first(
    model: Model,
    columns: Mapping[str, Array],
    sent: Mapping[str, Array],
    dt: float,
    ranges: Mapping[str, tuple[float, float] | None],
) -> dict[str, float]:
    """Where a robot stands as a log begins, and the inputs, not all 0, that hold it there.

    A controller that holds it sags at first and lets its commands tremble: what counts is that they
    stay about where they are in the second half of the time. {} where the robot moves, where an
    input changes, or where nothing has to hold it: then the input counts as 0 before a run, which
    is also what is sent after one. Without a speed among the states nothing tells a robot that
    stands from one that goes on slowly.

    Args:
        model: whose states and inputs they are.
        columns: states, by name (H + 1,).
        sent: inputs, by name (H,).
        dt: control interval [s].
        ranges: lowest and highest value of each signal in the whole log.
    """
    steps = round(STOOD / dt)
    speeds = {name for name, unit in model.states.items() if unit.endswith("/s")}
    whole = set(sent) == set(model.inputs) and set(columns) == set(model.states)
    if not speeds or not whole or steps < 2:
        return {}
    first = {name: values[:steps] for name, values in {**columns, **sent}.items()}
    if not all(len(v) == steps and np.isfinite(v).all() for v in first.values()):
        return {}
    found, held = {}, {}
    for name in columns:
        low, high = ranges[name] or (0.0, 0.0)
        most = max(abs(low), abs(high)) if name in speeds else high - low
        off = first[name].mean() if name in speeds else first[name][-1] - first[name][0]
        if abs(off) > STILL * most:
            return {}
        at = float(first[name][steps // 2 :].mean())
        if name not in speeds and abs(at) > STILL * most:
            found[name] = at
    needed = False
    for name in sent:
        low, high = ranges[name] or (0.0, 0.0)
        later = first[name][steps // 2 :]
        if np.ptp(later) > STILL * (high - low):
            return {}
        held[name] = float(later.mean() if np.ptp(later) else later[0])
        needed |= held[name] != 0 and (not np.ptp(later) or abs(held[name]) > STILL * (high - low))
    return found | held if needed else {}


def _span(ends: Sequence[float]) -> str:
    return f"[{', '.join(f'{end:.6g}' for end in ends)}]"


def _inline(values: Mapping[str, float]) -> str:
    return "{ " + ", ".join(f"{key(name)} = {value:.4g}" for name, value in values.items()) + " }"
