"""From a checked grounded.toml and a loaded model to the Task of the method."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded.model import Model
from grounded.task import Task
from grounded.utility import Reward
from grounded_trials.config import Config
from grounded_trials.model_file import check_names
from grounded_trials.target_file import target_arrays


def build_task(config: Config, model: Model, folder: Path) -> Task:
    """The task that the files describe; errors name the file and the key.

    Raises:
        GroundedError: for a name that is not in the model, or sizes that do not fit.
    """
    try:
        return _build(config, model, folder)
    except GroundedError as error:
        named = str(error).startswith((config.file.name, str(folder), config.task.target))
        raise GroundedError(f"{'' if named else config.file.name + ': '}{error}") from None


def _build(config: Config, model: Model, folder: Path) -> Task:
    states, inputs = list(model.state_names), list(model.input_names)
    table = config.task
    check_names(table.start, [*states, *inputs], "[task] start: state")
    check_names(table.latency, inputs, "[task] latency: input")
    path = (folder / table.target).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise GroundedError(f"[task] target = '{table.target}' lies outside the workspace")
    target, input_target = target_arrays(path, states, inputs, table.dt, table.horizon)
    first = np.where(np.isfinite(target[0]), target[0], 0.0)
    start = np.array([table.start.get(s, first[i]) for i, s in enumerate(states)])
    low, high = _limits(config, inputs)
    held = np.zeros(len(inputs)) if input_target is None else input_target[0]
    past = np.array([table.start.get(name, held[i]) for i, name in enumerate(inputs)])
    safety = config.safety.pairs(states)
    safe = np.array([safety.get(s, (-np.inf, np.inf)) for s in states])
    return Task(
        model=model,
        dt=table.dt,
        target=target,
        reward=_reward(config, states, inputs),
        start=start,
        past=np.clip(past, low, high),
        low=low,
        high=high,
        feedback=table.feedback,
        latency=np.array([table.latency.get(name, 0.0) for name in inputs]),
        input_target=input_target,
        safety_low=safe[:, 0],
        safety_high=safe[:, 1],
        smoothing=config.model.smoothing,
    )


def _limits(config: Config, inputs: list[str]) -> tuple[Array, Array]:
    pairs = config.limits.pairs(inputs)
    both = np.array([pairs.get(name, (-np.inf, np.inf)) for name in inputs])
    return both[:, 0], both[:, 1]


def _reward(config: Config, states: list[str], inputs: list[str]) -> Reward:
    table = config.reward
    kinds = {"state": states, "terminal": states, "input": inputs, "input_change": inputs}
    weights = {}
    for kind, names in kinds.items():
        given = table.numbers(kind, names)
        weights[kind] = np.array([given.get(name, 0.0) for name in names])
    table.finish()
    if not any(w.any() for w in (weights["state"], weights["terminal"])):
        raise GroundedError(
            "[reward] weighs no state: there is nothing to follow; add for example "
            f"state = {{ {states[0]} = 1.0 }}"
        )
    return Reward(**weights)
