"""A simulated REAL pendulum: heavier than the model thinks, with dry friction in its bearing."""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded.model import Model, Param
from grounded.models import pendulum

FRICTION = 0.5  # [N m]
HEAVIER = 1.3


def dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    """ds/dt with a torque that opposes the motion."""
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
