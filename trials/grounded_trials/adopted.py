"""Effects that grounded.toml says were adopted, as part of the model that plans.

    [model]
    effects = [ { name = "dead_zone:throttle", c = 0.146 } ]

A pure delay becomes latency of the task, a queue that the robot's runner knows; everything else
wraps the model (`grounded.effects`), with memory states where the effect has a memory.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from grounded.effects.order import wrapping_order
from grounded.effects.registry import Library
from grounded.effects.wrap import wrap
from grounded.errors import GroundedError
from grounded.planner import Planner, planner_for
from grounded.task import Task


def planner_with(
    task: Task, effects: Sequence[Mapping[str, Any]], library: Library | None = None
) -> Planner:
    """The planner of a task whose model got these effects, in the order in which they act.

    Raises:
        GroundedError: for an unknown effect, or a quantity that is missing or unknown.
    """
    library = library or Library()
    assert task.latency is not None
    model, latency = task.model, np.array(task.latency)
    families = [library.family(str(entry["name"]).partition(":")[0]) for entry in effects]
    for i in wrapping_order(families):
        entry = effects[i]
        name = str(entry["name"])
        values = {key: value for key, value in entry.items() if key != "name"}
        for key, value in values.items():
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise GroundedError(
                    f"grounded.toml: [model] effects: {name}: {key} must be a number, "
                    f"found {value!r}"
                )
        if families[i].name == "delay":
            for one in name.partition(":")[2].split("+"):
                latency[_input(task, name, one)] += float(values.get("d", 0.0))
            continue
        effect = library.effect(name, model)
        model = wrap(effect, {k: float(v) for k, v in values.items()}, task.dt)
    return planner_for(task, model, latency)


def _input(task: Task, name: str, target: str) -> int:
    if target not in task.model.input_names:
        raise GroundedError(f"grounded.toml: [model] effects: '{name}': '{target}' is not an input")
    return task.model.input_names.index(target)
