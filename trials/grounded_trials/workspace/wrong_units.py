"""Values of states that grounded.toml and the target give in another unit than the model's.

A target of 90 rad was meant as 90 degrees, a [safety] of 1500 m as millimetres. Nothing else tells:
the plan goes there, or never leaves [safety]. Stored logs show how far the robot really moved.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from grounded_trials.wording import with_unit
from grounded_trials.workspace.folder import Folder

BEYOND = 20.0  # times as far as any log: from there on, the unit is doubted
NEAR = (0.2, 10.0)  # times as far as the logs that a value reaches in the right unit
TURN = 2 * math.pi  # angles up to a turn are not doubted
OTHERS = {"m": ("mm", 1000.0), "rad": ("degrees", 180 / math.pi)}  # unit, factor; also a second


def in_another_unit(workspace: Folder) -> list[str]:
    """Return a note on each state whose target, start or [safety] seems to be in another unit.

    Args:
        workspace: whose stored logs say how far each state moves.
    """
    task = workspace.task
    logs = [one.trial for one in workspace.whole_trials() if workspace.fits(one.trial)]
    found = []
    for i, (name, unit) in enumerate(task.model.states.items() if logs else ()):
        base, _, per = unit.partition("/")
        if base not in OTHERS or per not in ("", "s"):
            continue
        other, factor = OTHERS[base]
        moved = max(_largest(t.states[:, i]) for t in logs)
        for what, most in _given(workspace, i):
            far = most > max(BEYOND * moved, TURN * (base == "rad"))
            if far and moved > 0 and NEAR[0] < most / factor / moved < NEAR[1]:
                given, seen = (with_unit(f"{v:.4g}", unit) for v in (most, moved))
                found.append(
                    f"{what} of {name} is {given}, {most / moved:.3g} times as far as it moves in "
                    f"any log ({seen}): if it is in {other}{per and ' a second'}, multiply it by "
                    f"{1 / factor:.8g}"
                )
    return found


def _given(workspace: Folder, i: int) -> Iterator[tuple[str, float]]:
    """Yield what is given of a state, as the subject of a sentence, and its largest value."""
    task = workspace.task
    assert task.safety_low is not None and task.safety_high is not None
    name = task.model.state_names[i]
    columns, _ = workspace.read_target(workspace.folder / str(workspace.config.task.target))
    if name in columns:
        yield "the target", _largest(task.target[:, i])
    if name in workspace.config.task.start:
        yield "[task] start", abs(float(task.start[i]))
    yield "[safety]", _largest(np.array([task.safety_low[i], task.safety_high[i]]))


def _largest(values: np.ndarray) -> float:
    """Return the largest absolute value that is finite; 0 without any."""
    return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
