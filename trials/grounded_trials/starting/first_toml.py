"""The first grounded.toml of a workspace that is made from a log, and its target.csv."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from grounded.frozen import Array
from grounded.model import Model
from grounded_trials.store.store import write_atomically
from grounded_trials.toml_table import key
from grounded_trials.workspace.config import FILE, OFFERED
from grounded_trials.workspace.off_target import position_names
from grounded_trials.workspace.task_file import change_weight, equal_weights, write_target


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
    """
    dt, whose = grid
    write_target(folder / "target.csv", dt, dict(columns))
    weights = equal_weights(columns, model.states, position_names(model))
    changes = {name: change_weight(ranges[name], model.inputs[name]) for name in model.input_names}
    limits = [
        f"{key(name)} = [{found[0]:.6g}, {found[1]:.6g}]"
        for name in model.input_names
        if (found := ranges[name]) is not None and found[0] < found[1]
    ]
    lines = [
        f"# made from a log by `grounded init --from` ({why})",
        "",
        "[model]",
        'file = "model.py"             # the crude model, plain NumPy',
        "",
        "[task]",
        f"dt = {dt:g}                     # [s] control interval{whose}",
        f"horizon = {horizon}                 # steps",
        'target = "target.csv"         # `grounded target` draws another; no column: free',
        "start = { }",
        "feedback = true               # false: open loop",
        "latency = { }                 # [s] transport delay of inputs: `fit --latency` finds it",
        "",
        "[reward]                      # quadratic weights: 1 / (range in the target)^2; `target`",
        "                              # sets them anew until you change one; of a column that",
        "                              # stays at 0: the largest of its unit, else 1",
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
            "# SEEN in the log, and 0: put in what your robot may get, then delete these two lines",
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


def _inline(values: Mapping[str, float]) -> str:
    return "{ " + ", ".join(f"{key(name)} = {value:.4g}" for name, value in values.items()) + " }"
