"""The systems of the blind challenge: models, noise levels and random manoeuvres.

A manoeuvre is a random sequence of inputs. Its rollout in the crude model is the target, and a
time-varying linear-quadratic regulator about it is the policy, so that the data are closed-loop, as
on real robots.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.challenge import mechanism
from grounded.compile import Named
from grounded.frozen import Array
from grounded.model import Model
from grounded.models.aircraft import model as aircraft_model
from grounded.models.aircraft_trim import level_trim
from grounded.models.arm import model as arm_model
from grounded.models.buggy import model as buggy_model
from grounded.models.car import model as car_model
from grounded.models.cart_pole import model as cart_pole_model
from grounded.models.lift import model as lift_model
from grounded.models.pendulum import model as pendulum_model


@dataclass(frozen=True, eq=False)
class SystemUnderTest:
    """A system: its model, limits, noise at level 1, random manoeuvres.

    `manoeuvre(rng, times, model)` returns inputs (T, m) and the start state (n,). `driven` is the
    state that withheld effects act on, `grows` is what process noise scales with (`Disturbance`),
    `built` writes the XML of its MuJoCo model.
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
    rates: tuple[float, ...] = (20.0, 30.0, 50.0)  # [Hz]
    latency: tuple[float, ...] = ()
    driven: str = "v"
    duration: tuple[float, float] = (5.0, 10.0)  # [s]
    settled: bool = False  # whether the first inputs were held before the start
    grows: tuple[str, float] | None = None
    bend: float = 0.05  # difference between trials of one task, as a fraction of the limits
    built: Callable[..., str] | None = None


def wave(rng: np.random.Generator, t: Any, count: int, low: float, high: float) -> Array:
    """Return a sum of sines of random frequency [Hz] and phase, with a peak of about 1."""
    total = np.zeros_like(t)
    for _ in range(count):
        f = rng.uniform(low, high)
        total += rng.uniform(0.4, 1.0) * np.sin(2 * np.pi * f * t + rng.uniform(0, 2 * np.pi))
    return np.asarray(total / np.sqrt(count))


def steps(rng: np.random.Generator, t: Array, low: float, high: float, every: float) -> Array:
    """Return random levels, each held for a random time around `every` seconds."""
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
    start, held = level_trim(model, 10.0, dt=float(t[1] - t[0]))
    u = np.tile(held, (len(t), 1))
    names = model.input_names
    u[:, names.index("throttle")] += 0.15 * steps(rng, t, -1, 1, 2.0)
    u[:, names.index("aileron")] += 0.03 * wave(rng, t, 2, 0.2, 0.8)
    u[:, names.index("elevator")] += 0.04 * wave(rng, t, 2, 0.2, 0.8)
    u[:, names.index("rudder")] += 0.06 * wave(rng, t, 2, 0.2, 0.8)
    start[model.state_names.index("altitude")] = 50.0
    return u, start


# The RC car of section 5.2 (20 to 50 Hz, overhead camera)
_CAR_NOISE = {"delta": 0.01, "v": 0.02, "x": 0.004, "y": 0.004, "psi": 0.01, "psi_rate": 0.1}
CAR = SystemUnderTest(
    name="car",
    model=car_model,
    low=np.array([-1.0, 0.0]),
    high=np.array([1.0, 1.0]),
    process=_CAR_NOISE | {"v": 0.03},
    measurement=_CAR_NOISE,
    tracking={"delta": 0.2, "v": 1.0, "x": 4.0, "y": 4.0, "psi": 1.0},
    effort=np.array([2.0, 2.0]),
    manoeuvre=_drive,
    latency=(0.1, 0.1),
)


# A torque-driven pendulum with an encoder
PENDULUM = SystemUnderTest(
    name="pendulum",
    model=pendulum_model,
    low=np.array([-5.0]),
    high=np.array([5.0]),
    process={"theta": 0.004, "omega": 0.06},
    measurement={"theta": 0.005, "omega": 0.05},
    tracking={"theta": 4.0, "omega": 0.4},
    effort=np.array([0.2]),
    manoeuvre=_swing,
    driven="omega",
)


# The small aircraft of section 5.1 (50 Hz)
AIRCRAFT = SystemUnderTest(
    name="aircraft",
    model=aircraft_model,
    low=np.array([0.0, -0.4, -0.4, -0.4]),
    high=np.array([1.0, 0.4, 0.4, 0.4]),
    process=dict.fromkeys("uvwpq", 0.05)
    | {"r": 0.03, "north": 0.02, "east": 0.02, "altitude": 0.02}
    | dict.fromkeys(("phi", "theta", "psi"), 0.003),
    measurement=dict.fromkeys(("north", "east", "altitude", "u", "v", "w"), 0.05)
    | {"phi": 0.005, "theta": 0.005, "psi": 0.008, "p": 0.02, "q": 0.02, "r": 0.02},
    tracking={"altitude": 0.05, "u": 0.05, "phi": 1.0, "theta": 1.0, "psi": 0.5, "p": 0.05},
    effort=np.array([4.0, 20.0, 20.0, 20.0]),
    manoeuvre=_fly,
    rates=(50.0,),
    driven="q",
    duration=(5.0, 7.0),
    settled=True,
)


def _crawl(rng: np.random.Generator, t: Array, model: Model) -> tuple[Array, Array]:
    u, start = _drive(rng, t, model)
    start[model.state_names.index("v")] = rng.uniform(0.0, 1.0)
    return u, start


# A car with a kink between driving and braking and noise that grows with speed
BUGGY = SystemUnderTest(
    name="buggy",
    model=buggy_model,
    low=np.array([-1.0, -0.3]),
    high=np.array([1.0, 1.0]),
    process={"x": 0.01, "y": 0.01, "psi": 0.04, "v": 0.15},
    measurement={"x": 0.004, "y": 0.004, "psi": 0.01, "v": 0.02},
    tracking={"x": 4.0, "y": 4.0, "psi": 1.0, "v": 1.0},
    effort=np.array([2.0, 2.0]),
    manoeuvre=_crawl,
    rates=(20.0, 50.0, 100.0),
    grows=("v", 1.5),
)


def _hoist(rng: np.random.Generator, t: Array, model: Model) -> tuple[Array, Array]:
    volts = rng.uniform(1.5, 5.0) * wave(rng, t, 3, 0.1, 1.0)
    if rng.random() < 0.4:
        volts = steps(rng, t, -4.0, 4.0, 0.8)
    return np.clip(volts, -6, 6)[:, None], np.zeros(2)


# An axis with kinks in drive and friction and noise that grows with speed
LIFT = SystemUnderTest(
    name="lift",
    model=lift_model,
    low=np.array([-6.0]),
    high=np.array([6.0]),
    process={"z": 0.001, "w": 0.12},
    measurement={"z": 0.002, "w": 0.02},
    tracking={"z": 10.0, "w": 0.5},
    effort=np.array([0.05]),
    manoeuvre=_hoist,
    rates=(20.0, 50.0, 100.0),
    driven="w",
    grows=("w", 0.7),
)


def _reach(rng: np.random.Generator, t: Array, model: Model) -> tuple[Array, Array]:
    """Return torques that move the crude model along waves about hanging, by inverse dynamics."""
    dt = float(t[1] - t[0])
    reach = rng.uniform(0.3, 1.1, 2)
    path = np.column_stack([r * wave(rng, t, 2, 0.15, 0.7) for r in reach])
    path += np.array([-np.pi / 2, rng.uniform(0.0, 0.8)])
    speed = np.gradient(path, dt, axis=0)
    wanted = np.gradient(speed, dt, axis=0)
    x = start = np.concatenate([path[0], speed[0]])
    u = np.empty((len(t), 2))
    for k in range(len(t)):
        free, by = _accelerations(model, x)
        pull = wanted[k] + 60 * (path[k] - x[:2]) + 15 * (speed[k] - x[2:])
        u[k] = np.clip(np.linalg.solve(by, pull - free), -15, 15)
        x = model.system.step(x[None], u[k][None], model.values, dt)[0]
    return u, start


def _accelerations(model: Model, x: Array) -> tuple[Array, Array]:
    """Return the joints' accelerations without torques (2,), and per unit of each torque (2, 2)."""
    assert model.derivative is not None
    p = Named("parameter", model.param_names, list(model.values))
    s, found = Named("state", model.state_names, list(x)), []
    for u in ([0.0, 0.0], [1.0, 0.0], [0.0, 1.0]):
        rate = model.derivative(s, Named("input", model.input_names, u), p)
        found.append(np.array([rate[n] for n in model.state_names[2:]]))
    return found[0], np.column_stack([found[1] - found[0], found[2] - found[0]])


# A two-link arm with encoders, whose real system is simulated by MuJoCo
ARM = SystemUnderTest(
    name="arm",
    model=arm_model,
    low=np.array([-15.0, -15.0]),
    high=np.array([15.0, 15.0]),
    process={"q1_vel": 0.03, "q2_vel": 0.05},
    measurement={"q1": 0.001, "q2": 0.001, "q1_vel": 0.01, "q2_vel": 0.01},
    tracking={"q1": 20.0, "q2": 20.0, "q1_vel": 0.3, "q2_vel": 0.3},
    effort=np.array([0.05, 0.05]),
    manoeuvre=_reach,
    rates=(50.0, 100.0),
    driven="q1_vel",
    duration=(4.0, 7.0),
    settled=True,
    bend=0.005,
    built=mechanism.arm_xml,
)


def _shove(rng: np.random.Generator, t: Array, model: Model) -> tuple[Array, Array]:
    force = rng.uniform(1.5, 5.0) * wave(rng, t, 3, 0.2, 1.0)
    if rng.random() < 0.3:
        force = steps(rng, t, -4.0, 4.0, 0.6)
    start = np.array([0.0, np.pi + rng.uniform(-0.4, 0.4), 0.0, 0.0])
    return np.clip(force, -10, 10)[:, None], start


# A cart with a hanging pole, whose real system is simulated by MuJoCo
CART_POLE = SystemUnderTest(
    name="cart_pole",
    model=cart_pole_model,
    low=np.array([-10.0]),
    high=np.array([10.0]),
    process={"x_vel": 0.02, "theta_vel": 0.03},
    measurement={"x": 0.002, "theta": 0.003, "x_vel": 0.02, "theta_vel": 0.03},
    tracking={"x": 5.0, "theta": 2.0, "x_vel": 0.5, "theta_vel": 0.2},
    effort=np.array([0.1]),
    manoeuvre=_shove,
    rates=(20.0, 50.0, 100.0),
    driven="x_vel",
    duration=(4.0, 8.0),
    bend=0.02,
    built=mechanism.cart_xml,
)


def regulator(
    system: SystemUnderTest, model: Model, u: Array, start: Array, dt: float
) -> tuple[Array, Array]:
    """Return the target (T + 1, n) in the crude model and the gains (T, m, n) of a regulator."""
    T, n = len(u), model.n
    x = np.empty((T + 1, n))
    x[0] = start
    lag = [round(late / dt) for late in system.latency] or [0] * model.m
    arrived = np.column_stack(
        [np.concatenate([np.zeros(d), u[: T - d, j]]) for j, d in enumerate(lag)]
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


SYSTEMS: Mapping[str, SystemUnderTest] = {
    one.name: one for one in (CAR, PENDULUM, AIRCRAFT, BUGGY, LIFT, ARM, CART_POLE)
}
GROUPS: dict[str, dict[str, float]] = {  # systems, and the probability of each
    "own": {"car": 0.6, "pendulum": 0.2, "aircraft": 0.2},
    "kinked": {"buggy": 0.6, "lift": 0.4},
    "mujoco": {"arm": 0.6, "cart_pole": 0.4},
}
