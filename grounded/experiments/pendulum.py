"""A pendulum's task (swing up in two seconds, then hold) and its simulated real system.

The real pendulum is heavier than the model assumes, and has dry friction in its bearing.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded.model import Model, Param
from grounded.models import pendulum
from grounded.task import Task
from grounded.utility import Reward

DT, UP, HOLD = 0.02, 2.0, 1.0  # [s]


def pendulum_task(model: Model) -> Task:
    """Return the task to follow a smooth swing to theta = pi with torques of at most 8 N m."""
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


FRICTION = 0.5  # [N m]
HEAVIER = 1.3


def dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    """Return ds/dt with dry friction."""
    crude = pendulum.dynamics(s, a, p)
    torque = p.friction * np.tanh(s.omega / 0.05)
    return {"theta": crude["theta"], "omega": crude["omega"] - torque / (p.m * p.l**2)}


model = Model(
    name="real pendulum",
    states=pendulum.model.states,
    inputs=pendulum.model.inputs,
    params={
        **pendulum.model.params,
        "m": Param(HEAVIER * pendulum.model.params["m"].value, "kg"),
        "friction": Param(FRICTION, "N m"),
    },
    roles=pendulum.model.roles,
    derivative=dynamics,
)
