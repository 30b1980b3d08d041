"""Manual driving of a car, filmed by a camera that sees two markers at 30 Hz (footnotes 15, 17)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grounded.estimate import Measurement, Record, of_function
from grounded.frozen import Array
from grounded.model import Model

RATE = 30  # [Hz] of the camera and of the driver's inputs
RUN = 60.0  # [s] length of one film
CAMERA = 0.002  # [m] noise of a marker's position
PROCESS = (2e-3, 1e-2, 3e-4, 3e-4, 5e-4, 1e-3)  # [state's unit] process noise per camera frame
START = (0.05, 0.02, CAMERA, CAMERA, 0.02, 0.1)  # standard deviation of the state of a car at rest


def markers(length: float) -> Measurement:
    """Return the camera's measurement: positions of front and rear marker, `length` apart [m]."""

    def seen(x: Array) -> Array:
        ahead = length * np.stack([np.cos(x[:, 4]), np.sin(x[:, 4])], axis=1)
        return np.hstack([x[:, 2:4] + ahead, x[:, 2:4]])

    def slopes(x: Array) -> Array:
        H = np.zeros((len(x), 4, 6))
        H[:, [0, 1, 2, 3], [2, 3, 2, 3]] = 1.0
        H[:, 0, 4], H[:, 1, 4] = -length * np.sin(x[:, 4]), length * np.cos(x[:, 4])
        return H

    return of_function(("front_x", "front_y", "rear_x", "rear_y"), seen, slopes)


def hands(steps: int, rng: np.random.Generator) -> Array:
    """Return a driver's steering and throttle (steps, 2): circles, straights, corners, stops."""
    u = np.zeros((steps, 2))
    t, target = 0, np.zeros(2)
    while t < steps:
        kind = rng.choice(
            ["circle", "straight", "slow", "stop", "weave"], p=[0.4, 0.2, 0.2, 0.1, 0.1]
        )
        steering = 0.0 if kind == "straight" else rng.uniform(-1, 1)
        throttle = {
            "circle": rng.uniform(0.3, 0.8),
            "straight": rng.uniform(0.25, 0.7),
            "slow": rng.uniform(0.1, 0.35),
            "stop": 0.0,
            "weave": rng.uniform(0.3, 0.6),
        }[str(kind)]
        if kind == "slow":
            steering *= 0.3
        last, target = target, np.array([steering, throttle])
        count = int(rng.integers(20, 120))
        ramp = np.minimum(np.arange(1, count + 1) / rng.integers(1, 8), 1.0)[:, None]
        piece = last + ramp * (target - last)
        if kind == "weave":
            piece[:, 0] *= np.cos(2 * np.pi * np.arange(count) / rng.integers(20, 60))
        u[t : t + count] = piece[: steps - t]
        t += count
    return np.asarray(np.clip(u + 0.01 * rng.standard_normal(u.shape) * (u != 0), -1, 1))


def drive(truth: Model, latency: float, minutes: float, rng: np.random.Generator) -> list[Record]:
    """Return films of a minute each: the camera's measurements and the driver's commands."""
    steps = round(RUN * RATE)
    commands = [hands(steps, rng) for _ in range(max(1, round(minutes * 60 / RUN)))]
    see = markers(truth.params["L"].value)
    return film(truth, np.full(2, latency), commands, see, rng)


def film(
    truth: Model,
    latency: Array,
    commands: Sequence[Array],
    see: Measurement,
    rng: np.random.Generator,
    *,
    camera: float = CAMERA,
    process: Sequence[float] = PROCESS,
) -> list[Record]:
    """Simulate the film of a car that is driven from rest, one record per run.

    Args:
        truth: the car, its states in the order of `grounded.models.car`.
        latency: true transport delay of each input [s], (2,).
        commands: steering and throttle of each run, all of the same length, (steps, 2).
        see: the measurement of the markers.
        rng: random generator of process and measurement noise.
        camera: noise of a marker's position [m].
        process: process noise of each state per frame, (6,).
    """
    steps, runs = len(commands[0]), len(commands)
    times = np.asarray(np.arange(steps + 1) / RATE)
    nothing = np.zeros((steps + 1, 4))
    received = np.stack(
        [Record(times, nothing, times[:-1], u).received(latency)[0] for u in commands], axis=1
    )
    x = np.zeros((steps + 1, runs, 6))
    for t in range(steps):
        w = np.array(process) * rng.standard_normal((runs, 6))
        x[t + 1] = truth.system.step(x[t], received[t], truth.values, 1 / RATE) + w
    films = []
    for run, u in enumerate(commands):
        y = see.function(x[:, run]) + camera * rng.standard_normal((steps + 1, 4))
        start, start_std = at_rest(y[0])
        films.append(Record(times, y, times[:-1], u, start=start, start_std=start_std))
    return films


def at_rest(y: Array) -> tuple[Array, Array]:
    """Return the state (6,) of a car at rest from its first frame y (4,), and its std (6,)."""
    ahead = y[:2] - y[2:]
    start = np.array([0.0, 0.0, *y[2:], np.arctan2(ahead[1], ahead[0]), 0.0])
    return start, np.array(START)
