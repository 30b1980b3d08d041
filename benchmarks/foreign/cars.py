"""Two cars of CommonRoad, the single-track drift model and the 29-state multi-body model.

The crude model is the kinematic bicycle: no slip, no tyres. The task is a lane change at the speed
that takes the lateral acceleration named by the set-up.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.foreign.robots import Robot, task_of
from grounded.model import Model, Param
from grounded.task import Task

WIDTH, TIME_FACTOR = 3.5, 5.77  # [m] of a lane; peak of the second derivative of the jerk-free path


class CommonRoad:
    """vehicle_dynamics_std ("drift") or vehicle_dynamics_mb ("multi-body"), Runge-Kutta."""

    timestep = 0.005

    def __init__(self, kind: str, speed: float) -> None:
        from vehiclemodels import init_mb, init_std, vehicle_dynamics_mb, vehicle_dynamics_std
        from vehiclemodels.parameters_vehicle2 import parameters_vehicle2

        self.parameters = parameters_vehicle2()
        core = [0.0, 0.0, 0.0, speed, 0.0, 0.0, 0.0]
        self.multi = kind == "multi-body"
        if self.multi:
            self.f = vehicle_dynamics_mb.vehicle_dynamics_mb
            self.start = init_mb.init_mb(core, self.parameters)
        else:
            self.f = vehicle_dynamics_std.vehicle_dynamics_std
            self.start = init_std.init_std(core, self.parameters)

    def reset(self) -> None:
        self.x = np.array(self.start, dtype=float)

    def measure(self) -> np.ndarray:
        """Return delta, v, x, y, psi."""
        return self.x[[2, 3, 0, 1, 4]]

    def advance(self, u: np.ndarray) -> None:
        h, x, u = self.timestep, self.x, [float(value) for value in u]
        try:
            k1 = self.rate(x, u)
            k2 = self.rate(x + h / 2 * k1, u)
            k3 = self.rate(x + h / 2 * k2, u)
            k4 = self.rate(x + h * k3, u)
            self.x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        except (ArithmeticError, ValueError):
            self.x = np.full_like(x, np.nan)

    def rate(self, x: np.ndarray, u: list[float]) -> np.ndarray:
        return np.array(self.f(x.tolist(), list(u), self.parameters))


def dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    """Return ds/dt of a bicycle without slip, about its rear axle."""
    return {
        "delta": a.steering_rate,
        "v": a.acceleration,
        "x": s.v * np.cos(s.psi),
        "y": s.v * np.sin(s.psi),
        "psi": s.v * np.tan(s.delta) / p.L,
    }


def model() -> Model:
    return Model(
        name="bicycle",
        states={"delta": "rad", "v": "m/s", "x": "m", "y": "m", "psi": "rad"},
        inputs={"steering_rate": "rad/s", "acceleration": "m/s^2"},
        params={"L": Param(2.58, "m", 1.5, 8.0)},
        angles=("psi",),
        roles={"position": ("x", "y"), "heading": "psi", "speed": "v"},
        derivative=dynamics,
    )


def speed_of(acceleration: float) -> float:
    """Return the speed [m/s] at which a lane change over 26 m takes that lateral acceleration."""
    return 26.0 / float(np.sqrt(TIME_FACTOR * WIDTH / acceleration))


def task(acceleration: float) -> Task:
    """Return the task: the lane change, then a second of straight driving."""
    dt, speed = 0.05, speed_of(acceleration)
    H = round((26.0 / speed + 1.0) / dt)
    t = dt * np.arange(H + 1)
    s = np.clip(t * speed / 26.0, 0.0, 1.0)
    y = WIDTH * (10 * s**3 - 15 * s**4 + 6 * s**5)
    target = np.full((H + 1, 5), np.nan)
    target[:, 2], target[:, 3] = speed * t, y
    return task_of(
        model(),
        dt,
        target,
        np.array([0.0, speed, 0.0, 0.0, 0.0]),
        np.array([0.4, 8.0]),
        state={"x": 0.1, "y": 1.0},
        terminal={"y": 5.0},
        input=[0.05, 0.001],
        change=[0.1, 0.001],
    )


def robot(kind: str, acceleration: float) -> Robot:
    return Robot(CommonRoad(kind, speed_of(acceleration)))
