"""The pendulum's task: from hanging to standing in two seconds, then hold."""

from __future__ import annotations

import numpy as np

from grounded.model import Model
from grounded.task import Task
from grounded.utility import Reward

DT, UP, HOLD = 0.02, 2.0, 1.0  # [s]


def pendulum_task(model: Model) -> Task:
    """Follow a smooth swing to theta = pi with torques of at most 8 N m."""
    t = DT * np.arange(round((UP + HOLD) / DT) + 1)
    part = np.clip(t / UP, 0.0, 1.0)
    theta = np.pi * (10 * part**3 - 15 * part**4 + 6 * part**5)  # rest to rest, minimum jerk
    return Task(
        model=model,
        dt=DT,
        target=np.column_stack([theta, np.full(len(t), np.nan)]),
        reward=Reward(
            state=np.array([10.0, 0.0]),
            terminal=np.zeros(2),
            input=np.array([0.001]),
            input_change=np.array([0.01]),
        ),
        start=np.zeros(2),
        past=np.zeros(1),
        low=np.array([-8.0]),
        high=np.array([8.0]),
    )
