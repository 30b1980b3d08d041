"""The car's three manoeuvres of section 5.2, all from standstill, at 20 Hz.

    turn      open loop: a quarter turn whose speed and radius vary
    circle    closed loop: 1.4 m/s on a circle of 1 m radius
    figure-8  closed loop: 1.4 m/s in straights, 1.0 m/s in the turns, radius 0.5 m

A target is the exact motion of a kinematic car along a path of smooth curvature kappa(s) at a
smooth speed V(t) of the front wheels: delta = atan(kappa L), rear-axle speed V cos(delta),
psi' = V sin(delta) / L. It accelerates at RAMP_UP and slows down at RAMP_DOWN (the car brakes at
about 1 m/s^2).
"""

from __future__ import annotations

import numpy as np

from grounded.frozen import Array
from grounded.model import Model
from grounded.solve.bias import hann_smoothed
from grounded.task import Task
from grounded.utility import Reward

DT = 0.05  # [s] 20 Hz (footnote 18)
LATENCY = 0.1  # [s] input to camera (footnote 17)
RAMP_UP, RAMP_DOWN = 1.2, 0.6  # [m/s^2]
WEIGHTS = {"x": 10.0, "y": 10.0, "psi": 1.0, "v": 1.0}
INPUT_WEIGHT, CHANGE_WEIGHT = 0.01, 0.3
NAMES = ("turn", "circle", "figure8")
FINE = 20  # integration steps within a control step

_Profile = list[tuple[float, float, float]]  # length [m], curvature [1/m], speed limit [m/s]


def _path(name: str) -> tuple[_Profile, float]:
    """Return the segments of a manoeuvre and its duration [s]."""
    quarter = np.pi / 2
    if name == "turn":
        return [(0.7, 0.0, 1.2), (quarter * 0.7, 1 / 0.7, 1.0), (2.0, 0.0, 1.4)], 3.0
    if name == "circle":
        return [(0.3, 0.0, 1.4), (100.0, 1.0, 1.4)], 10.0
    r, straight = 0.5, 1.0  # two 270-degree arcs joined by two straights crossing at the middle
    arc = 1.5 * np.pi * r
    lap = [(straight / 2, 0.0, 1.4), (arc, 1 / r, 1.0), (straight, 0.0, 1.4), (arc, -1 / r, 1.0)]
    return [*lap, (straight, 0.0, 1.4), *lap[1:], (straight, 0.0, 1.4)], 10.0


def target(name: str, wheelbase: float = 0.15) -> Array:
    """Return the target states (H + 1, 6), all set, in the order of `grounded.models.car`."""
    profile, duration = _path(name)
    H = round(duration / DT)
    ends = np.cumsum([length for length, _, _ in profile])
    s_grid = np.linspace(0.0, ends[-1], 4001)
    segment = np.minimum(np.searchsorted(ends, s_grid, side="right"), len(profile) - 1)
    width = round(0.25 / s_grid[1]) // 2 * 2  # steps in 0.25 m, an even number
    kappa = hann_smoothed(np.array([profile[i][1] for i in segment]), width)
    limit = np.array([profile[i][2] for i in segment])
    speed_limit = _reachable(limit, s_grid[1])
    h = DT / FINE
    s, v, x, y, psi = 0.0, 0.0, 0.0, 0.0, 0.0
    rows = []
    for i in range(H * FINE + 1):
        delta = np.arctan(np.interp(s, s_grid, kappa) * wheelbase)
        if i % FINE == 0:
            rows.append((delta, v, x, y, psi, v * np.sin(delta) / wheelbase))
        rear = v * np.cos(delta)
        turn = v * np.sin(delta) / wheelbase
        middle = psi + 0.5 * h * turn
        x, y, psi = x + h * rear * np.cos(middle), y + h * rear * np.sin(middle), psi + h * turn
        s += h * rear
        v = min(v + h * RAMP_UP, float(np.interp(s, s_grid, speed_limit)))
    return np.array(rows)


def _reachable(limit: Array, step: float) -> Array:
    """Return the speed limit, lowered ahead of slow segments so that RAMP_DOWN suffices."""
    reachable = limit.copy()
    for i in range(len(limit) - 2, -1, -1):
        reachable[i] = min(limit[i], np.sqrt(reachable[i + 1] ** 2 + 2 * RAMP_DOWN * step))
    return reachable


def car_task(name: str, model: Model) -> Task:
    """Return one of NAMES as a task for a car model, tracking position, heading and speed."""
    states = target(name)
    tracked = np.array([state in WEIGHTS for state in model.state_names])
    weights = np.array([WEIGHTS.get(state, 0.0) for state in model.state_names])
    return Task(
        model=model,
        dt=DT,
        target=np.where(tracked, states, np.nan),
        reward=Reward(
            state=weights,
            terminal=np.zeros(model.n),
            input=np.full(2, INPUT_WEIGHT),
            input_change=np.full(2, CHANGE_WEIGHT),
        ),
        start=np.zeros(model.n),
        past=np.zeros(2),
        low=np.full(2, -1.0),
        high=np.full(2, 1.0),
        feedback=name != "turn",
        latency=np.full(2, LATENCY),
    )
