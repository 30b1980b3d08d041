"""The systems of the blind challenge: what is driven, how, and how noisy it is.

A manoeuvre is a random sequence of inputs, its run in the crude model is the target, and a
time-varying linear-quadratic regulator about it is the policy: closed-loop data, as real ones are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.frozen import Array
from grounded.model import Model


@dataclass(frozen=True, eq=False)
class SystemUnderTest:
    """A system: its model, limits, noise at level 1, random manoeuvres.

    `manoeuvre(rng, times, model)` gives inputs (T, m) and the start state (n,).
    """

    name: str
    model: Model
    low: Array
    high: Array
    process: dict[str, float]  # unit / sqrt(s)
    measurement: dict[str, float]
    tracking: dict[str, float]  # weights of the regulator
    effort: Array  # (m,) weights of inputs
    manoeuvre: Callable[[np.random.Generator, Any, Model], tuple[Array, Array]]
    held: Array
    rates: tuple[float, ...] = (20.0, 30.0, 50.0)  # [Hz]
    latency: tuple[float, ...] = ()


def wave(rng: np.random.Generator, t: Any, count: int, low: float, high: float) -> Array:
    """A sum of sines of random frequency [Hz] and phase, peak about 1."""
    total = np.zeros_like(t)
    for _ in range(count):
        f = rng.uniform(low, high)
        total += rng.uniform(0.4, 1.0) * np.sin(2 * np.pi * f * t + rng.uniform(0, 2 * np.pi))
    return np.asarray(total / np.sqrt(count))


def steps(rng: np.random.Generator, t: Array, low: float, high: float, every: float) -> Array:
    """Levels held for a random time around `every` seconds."""
    out, at = np.empty_like(t), 0.0
    while at < t[-1] + 1:
        out[t >= at - 1e-9] = rng.uniform(low, high)
        at += rng.uniform(0.5, 1.5) * every
    return out


def _drive(rng: np.random.Generator, t: Array, model: Model) -> tuple[Array, Array]:
    amplitude = rng.uniform(0.25, 0.8)
    steering = amplitude * wave(rng, t, 2, 0.08, 0.6) + rng.uniform(-0.2, 0.2)
    if rng.random() < 0.3:
        steering = steps(rng, t, -amplitude, amplitude, 1.2)
    throttle = rng.uniform(0.35, 0.65) + 0.25 * wave(rng, t, 2, 0.05, 0.4)
    if rng.random() < 0.4:
        throttle = steps(rng, t, 0.1, 0.8, 1.5)
    if rng.random() < 0.3:
        throttle = np.where(t > t[-1] * rng.uniform(0.75, 0.95), 0.0, throttle)
    u = np.column_stack([np.clip(steering, -1, 1), np.clip(throttle, 0.0, 1.0)])
    start = np.zeros(model.n)
    start[model.state_names.index("psi")] = rng.uniform(-np.pi, np.pi)
    return u, start


def _swing(rng: np.random.Generator, t: Array, model: Model) -> tuple[Array, Array]:
    torque = rng.uniform(1.0, 4.0) * wave(rng, t, 3, 0.1, 1.2)
    if rng.random() < 0.4:
        torque = steps(rng, t, -3.5, 3.5, 0.8)
    start = np.array([rng.uniform(-1, 1), rng.uniform(-1, 1)])
    return np.clip(torque, -5, 5)[:, None], start


def _fly(rng: np.random.Generator, t: Array, model: Model) -> tuple[Array, Array]:
    from grounded.models.aircraft_trim import level_trim

    level = level_trim(model, np.array([10.0]), np.array([0.0]), float(t[1] - t[0]))
    u = np.tile(level.inputs[0], (len(t), 1))
    names = model.input_names
    u[:, names.index("throttle")] += 0.15 * steps(rng, t, -1, 1, 2.0)
    u[:, names.index("aileron")] += 0.03 * wave(rng, t, 2, 0.2, 0.8)
    u[:, names.index("elevator")] += 0.04 * wave(rng, t, 2, 0.2, 0.8)
    u[:, names.index("rudder")] += 0.06 * wave(rng, t, 2, 0.2, 0.8)
    start = level.states[0].copy()
    start[model.state_names.index("altitude")] = 50.0
    return u, start


def car() -> SystemUnderTest:
    """The RC car of section 5.2 (20 to 50 Hz, overhead camera)."""
    from grounded.models.car import model

    process = {"delta": 0.01, "v": 0.03, "x": 0.004, "y": 0.004, "psi": 0.01, "psi_rate": 0.1}
    measured = {"delta": 0.01, "v": 0.02, "x": 0.004, "y": 0.004, "psi": 0.01, "psi_rate": 0.1}
    return SystemUnderTest(
        name="car",
        model=model,
        low=np.array([-1.0, 0.0]),
        high=np.array([1.0, 1.0]),
        process=process,
        measurement=measured,
        tracking={"delta": 0.2, "v": 1.0, "x": 4.0, "y": 4.0, "psi": 1.0},
        effort=np.array([2.0, 2.0]),
        manoeuvre=_drive,
        held=np.zeros(2),
        latency=(0.1, 0.1),
    )


def pendulum() -> SystemUnderTest:
    """A torque-driven pendulum with an encoder."""
    from grounded.models.pendulum import model

    return SystemUnderTest(
        name="pendulum",
        model=model,
        low=np.array([-5.0]),
        high=np.array([5.0]),
        process={"theta": 0.004, "omega": 0.06},
        measurement={"theta": 0.005, "omega": 0.05},
        tracking={"theta": 4.0, "omega": 0.4},
        effort=np.array([0.2]),
        manoeuvre=_swing,
        held=np.zeros(1),
    )


def aircraft() -> SystemUnderTest:
    """The small aircraft of section 5.1 (50 Hz)."""
    from grounded.models.aircraft import model

    process = {"u": 0.05, "v": 0.05, "w": 0.05, "p": 0.05, "q": 0.05, "r": 0.03}
    process |= {"north": 0.02, "east": 0.02, "altitude": 0.02, "phi": 0.003, "theta": 0.003}
    process |= {"psi": 0.003}
    measured = {"north": 0.05, "east": 0.05, "altitude": 0.05, "u": 0.05, "v": 0.05, "w": 0.05}
    measured |= {"phi": 0.005, "theta": 0.005, "psi": 0.008, "p": 0.02, "q": 0.02, "r": 0.02}
    return SystemUnderTest(
        name="aircraft",
        model=model,
        low=np.array([0.0, -0.4, -0.4, -0.4]),
        high=np.array([1.0, 0.4, 0.4, 0.4]),
        process=process,
        measurement=measured,
        tracking={"altitude": 0.05, "u": 0.05, "phi": 1.0, "theta": 1.0, "psi": 0.5, "p": 0.05},
        effort=np.array([4.0, 20.0, 20.0, 20.0]),
        manoeuvre=_fly,
        held=np.zeros(4),
        rates=(50.0,),
    )


def regulator(
    system: SystemUnderTest, model: Model, u: Array, start: Array, dt: float
) -> tuple[Array, Array]:
    """The target (T + 1, n) in the crude model and the gains (T, m, n) of a regulator about it."""
    T, n = len(u), model.n
    x = np.empty((T + 1, n))
    x[0] = start
    lag = [round(late / dt) for late in system.latency] or [0] * model.m
    arrived = np.column_stack(
        [np.concatenate([np.full(d, system.held[j]), u[: T - d, j]]) for j, d in enumerate(lag)]
    )
    for t in range(T):
        x[t + 1] = model.system.step(x[t][None], arrived[t][None], model.values, dt)[0]
    f_x, f_u = model.system.linearise(x[:-1], arrived, model.values, dt)
    W = np.diag([system.tracking.get(name, 1e-3) for name in model.state_names])
    R, V, K = np.diag(system.effort), 5 * W, np.empty((T, model.m, n))
    for t in range(T - 1, -1, -1):
        BV = f_u[t].T @ V
        K[t] = -np.linalg.solve(R + BV @ f_u[t], BV @ f_x[t])
        closed = f_x[t] + f_u[t] @ K[t]
        V = W + K[t].T @ R @ K[t] + closed.T @ V @ closed
    return x, 0.7 * K


SYSTEMS: dict[str, Any] = {"car": car, "pendulum": pendulum, "aircraft": aircraft}
