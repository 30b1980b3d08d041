"""A plant with more or less of its own noise, and a policy's TRUE utility under it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from grounded.plant import Noise, Plant
from grounded.policy import Policy
from grounded.task import Task


def scaled(plant: Plant, level: float) -> Plant:
    """The plant with all standard deviations times `level`."""
    noise = Noise(
        **{
            kind: {name: level * std for name, std in getattr(plant.noise, kind).items()}
            for kind in ("start", "process", "measurement")
        }
    )
    return replace(plant, noise=noise)


def start_of(task: Task) -> dict[str, float]:
    """The start state by name."""
    return dict(zip(task.model.state_names, map(float, task.start), strict=True))


def true_utility(task: Task, plant: Plant, policy: Policy, runs: int, seed: int = 1) -> float:
    """Mean utility of fresh runs of a policy: what a winner's own trials flatter.

    A run that crashes counts with the utility of a car that stayed at the start.
    """
    streams = [np.random.default_rng([seed, 7, i]) for i in range(runs)]
    utilities = [task.utility(plant.run(policy, start_of(task), rng)) for rng in streams]
    return float(np.mean(np.maximum(utilities, standing_still(task))))


def standing_still(task: Task) -> float:
    """Utility of never moving: a floor for runs that ended early."""
    error = task.model.difference(np.tile(task.start, (task.horizon + 1, 1)), task.target)
    return -float((np.nan_to_num(error) ** 2 @ task.reward.state).sum())
