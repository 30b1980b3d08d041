"""The aircraft's figure-8: the target of section 5.1 and the task that flies it.

"The target trajectory was a figure-8 at fixed altitude with varying speed: slower in the turns,
faster in the straight segments ... 60 seconds long" (footnote 13). The paper gives no sizes. Ours:

    half a straight, 270 degrees to the left, a straight, 270 degrees to the right, half a straight

with arcs of radius R = 42 m. Two straights that cross at a right angle touch both circles a
distance R from the crossing, so each is 2 R long. Turns at 9 m/s, straights at 11 m/s, ramps of
1 m/s^2 on the straights: one lap takes 59.98 s. Curvature kappa and speed V are each smoothed over
1 s by a Hann window, then

    chi' = kappa V,    north' = V cos(chi),    east' = V sin(chi),    altitude' = 0.
"""

from __future__ import annotations

import math

import numpy as np

from grounded.frozen import Array
from grounded.model import Model
from grounded.models.aircraft_trim import level_trim
from grounded.solve.bias import hann_smoothed
from grounded.task import Task
from grounded.utility import Reward

DT = 0.02  # [s] 50 Hz
DURATION = 60.0  # [s]
RADIUS = 42.0  # [m]
SLOW, FAST = 9.0, 11.0  # [m/s] in the turns, on the straights
RAMP = 1.0  # [m/s2]
SMOOTHING = 1.0  # [s] width of the Hann window
POSITION, INPUT, CHANGE = 1.0, 1.0, 1e5  # weights; the gain of learning depends on CHANGE
LIMITS = {
    "throttle": (0.0, 1.0),
    "aileron": (-0.8, 0.8),
    "elevator": (-0.8, 0.8),
    "rudder": (-0.8, 0.8),
}  # [1, rad] of motor and servos; wide enough for the trims of 99 of 100 perturbed models


def figure8_profile() -> tuple[Array, Array]:
    """Return speed [m/s] and curvature [1/m] (positive to the right) before smoothing, (H + 1,)."""
    ramp = (FAST - SLOW) / RAMP
    run_up = (FAST**2 - SLOW**2) / (2 * RAMP)
    arc = 1.5 * math.pi * RADIUS / SLOW
    half = (RADIUS - run_up) / FAST
    whole = 2 * half
    corners = np.cumsum([0, half, ramp, arc, ramp, whole, ramp, arc, ramp, half])
    speeds = [FAST, FAST, SLOW, SLOW, FAST, FAST, SLOW, SLOW, FAST, FAST]
    t = np.arange(round(DURATION / DT) + 1) * DT
    speed = np.interp(t, corners, speeds)
    left = (t >= corners[2]) & (t < corners[3])
    right = (t >= corners[6]) & (t < corners[7])
    return speed, (right * 1.0 - left * 1.0) / RADIUS


def figure8_target() -> tuple[Array, Array, Array]:
    """Return north, east, altitude [m] (H + 1, 3), speed [m/s] and turn rate [rad/s] (H + 1,)."""
    speed, curvature = (hann_smoothed(s, round(SMOOTHING / DT)) for s in figure8_profile())
    rate = curvature * speed
    track = np.concatenate([[0.0], np.cumsum(0.5 * DT * (rate[1:] + rate[:-1]))])
    velocity = speed[:, None] * np.column_stack([np.cos(track), np.sin(track)])
    path = np.zeros((len(speed), 3))
    path[1:, :2] = np.cumsum(0.5 * DT * (velocity[1:] + velocity[:-1]), axis=0)
    return path, speed, rate


def flight_task(model: Model, started_by: Model | None = None) -> Task:
    """Return the figure-8 as a task for a model of the aircraft; only positions are tracked.

    Weights per step: 1 on each position error [1/m2], 1 on inputs, 1e5 on input changes.

    Args:
        model: the aircraft, possibly with wrong parameters.
        started_by: the aircraft whose trim in straight flight is the start, measured before the
            manoeuvre begins (states and held inputs); None: the model itself.
    """
    path, speed, _ = figure8_target()
    names = list(model.state_names)
    target = np.full((len(path), model.n), np.nan)
    columns = [names.index(name) for name in ("north", "east", "altitude")]
    target[:, columns] = path
    weights = np.zeros(model.n)
    weights[columns] = POSITION
    start, held = level_trim(started_by or model, float(speed[0]), dt=DT)
    low, high = np.array([LIMITS[name] for name in model.input_names]).T
    ones = np.ones(model.m)
    return Task(
        model=model,
        dt=DT,
        target=target,
        reward=Reward(weights, np.zeros(model.n), INPUT * ones, CHANGE * ones),
        start=start,
        past=held,
        low=low,
        high=high,
    )


def perturbed(model: Model, rng: np.random.Generator) -> Model:
    """Return a model with every parameter times an independent U[0.8, 1.2]."""
    factors = rng.uniform(0.8, 1.2, len(model.values))
    return model.with_values(dict(zip(model.param_names, model.values * factors, strict=True)))
