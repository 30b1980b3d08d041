"""Small models and tasks on which the loop runs in milliseconds, and differing real systems."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from grounded.model import Model, Param
from grounded.plant import Plant
from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import Trial
from grounded.utility import Reward


def cart_dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    return {"x": s.v, "v": (a.force - p.drag * s.v) / p.mass}


def rover_dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    speed = p.gain * np.where(a.speed > p.dead, a.speed, 0.0)
    return {"x": speed * np.cos(s.psi), "y": speed * np.sin(s.psi), "psi": p.yaw * a.turn}


def branching_step(s: Any, a: Any, p: Any, dt: float) -> dict[str, Any]:
    """Step with a Python `if` on the state, which no tracer can follow."""
    pull = -p.k * s.x if s.x > 0 else -2 * p.k * s.x
    v = s.v + dt * (a.force + pull)
    return {"x": s.x + dt * v, "v": v}


cart = Model(
    name="cart",
    states={"x": "m", "v": "m/s"},
    inputs={"force": "N"},
    params={"mass": Param(1.0, "kg", 0.1, 10.0), "drag": Param(0.2, "N s/m", 0.0, 5.0)},
    roles={"position": ("x",), "speed": "v"},
    derivative=cart_dynamics,
)
rover = Model(
    name="rover",
    states={"x": "m", "y": "m", "psi": "rad"},
    inputs={"speed": "m/s", "turn": "rad/s"},
    params={"gain": Param(1.0, "1", 0.1, 10.0), "yaw": Param(1.0), "dead": Param(0.05, "m/s")},
    angles=("psi",),
    roles={"position": ("x", "y"), "heading": "psi"},
    derivative=rover_dynamics,
)
black_box = Model(
    name="black box",
    states={"x": "m", "v": "m/s"},
    inputs={"force": "N"},
    params={"k": Param(1.0)},
    step=branching_step,
)


def cart_task(**changes: Any) -> Task:
    """Return a task of two seconds: one metre forward, from rest to rest."""
    t = np.linspace(0.0, 1.0, 41)
    x = 10 * t**3 - 15 * t**4 + 6 * t**5
    fields: dict[str, Any] = {
        "model": cart,
        "dt": 0.05,
        "target": np.column_stack([x, np.full(41, np.nan)]),
        "reward": Reward(np.array([10.0, 0.0]), np.zeros(2), np.array([0.01]), np.array([0.01])),
        "start": np.zeros(2),
        "past": np.zeros(1),
        "low": np.array([-5.0]),
        "high": np.array([5.0]),
    }
    return Task(**fields | changes)


def rover_task(**changes: Any) -> Task:
    """Return a task of one and a half circles: the heading passes pi and 2 pi."""
    t = 0.05 * np.arange(61)
    psi = 3.0 * t
    target = np.column_stack([np.sin(psi) / 3, (1 - np.cos(psi)) / 3, psi])
    fields: dict[str, Any] = {
        "model": rover,
        "dt": 0.05,
        "target": target,
        "reward": Reward(
            np.array([10.0, 10.0, 1.0]), np.ones(3), np.full(2, 0.01), np.array([0.02, 0.03])
        ),
        "start": np.zeros(3),
        "past": np.array([0.5, 0.0]),
        "low": np.array([-2.0, -6.0]),
        "high": np.array([2.0, 6.0]),
        "latency": np.array([0.05, 0.02]),
    }
    return Task(**fields | changes)


def other(model: Model, factor: float = 1.2) -> Model:
    """Return the same robot as a real system, every parameter scaled by a factor."""
    return model.with_values({k: factor * v.value for k, v in model.params.items()})


def drive(task: Task, plant: Plant, candidate: Candidate, seed: int = 0) -> Trial:
    """Run a candidate once from the task's start."""
    start = dict(zip(task.model.state_names, map(float, task.start), strict=True))
    trial = plant.run(candidate.policy, start, np.random.default_rng(seed))
    return replace(trial, candidate=candidate.id, id=f"t-{candidate.id}-{seed}")
