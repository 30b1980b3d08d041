"""Trim: states and inputs of an aircraft in steady level flight, straight or turning.

Level flight at airspeed V and turn rate omega without sideslip: twelve equations for the eight
states u, v, w, phi, theta, p, q, r and the four inputs (Stevens & Lewis 2003, section 3.6; the
turn is coordinated by beta = 0),

    u' = v' = w' = phi' = theta' = p' = q' = r' = altitude' = 0,  psi' = omega,  |V| = V,  v = 0,

solved for the discrete model, x_{t+1} - x_t over one control step, so that the trim is exact in the
simulation and works for any model with an aircraft's states, including adopted effects. All flight
conditions are solved at once by Newton's method on the linearised model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grounded.checks import known, wrong
from grounded.frozen import Array, readonly
from grounded.model import Model

GRAVITY = 9.81  # [m/s2], for the first guess of the bank angle
STEADY = ("u", "v", "w", "phi", "theta", "p", "q", "r", "altitude")
FREE = ("u", "v", "w", "phi", "theta", "p", "q", "r")


@dataclass(frozen=True, eq=False)
class Trim:
    """States (N, 12) at the origin with a track due north, and inputs (N, 4)."""

    states: Array
    inputs: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "states", readonly(self.states))
        object.__setattr__(self, "inputs", readonly(self.inputs))


def level_trim(model: Model, speed: Array, turn_rate: Array, dt: float = 0.02) -> Trim:
    """Return the trim of steady level flight for each pair of airspeed and turn rate.

    Args:
        model: a model with the state and input names of `grounded.models.aircraft`.
        speed: airspeed V [m/s], (N,).
        turn_rate: omega [rad/s], positive to the right, (N,).
        dt: control step [s].

    Raises:
        GroundedError: if the model is not an aircraft, or a condition has no trim.
    """
    speed, turn_rate = np.broadcast_arrays(np.atleast_1d(speed), np.atleast_1d(turn_rate))
    names = model.state_names
    known("state", [*FREE, "north", "east", "altitude", "psi"], names, f"model '{model.name}'")
    x, a = _first_guess(model, speed, turn_rate)
    free = [names.index(name) for name in FREE]
    worst = np.inf
    for _ in range(20):
        error, slope = _equations(model, x, a, speed, turn_rate, dt)
        worst = float(np.abs(error).max())
        if not np.isfinite(worst) or worst < 1e-10:
            break
        try:
            step = np.linalg.solve(slope, -error[..., None])[..., 0]
        except np.linalg.LinAlgError:  # without air the control surfaces have no effect
            break
        scale = np.minimum(1.0, 0.5 / np.maximum(np.abs(step / (1 + speed[:, None])).max(1), 1e-12))
        x[:, free] += scale[:, None] * step[:, : len(free)]
        a += scale[:, None] * step[:, len(free) :]
    if not worst < 1e-6:
        got = (
            f"{speed.min():.2f} to {speed.max():.2f} m/s, up to {np.abs(turn_rate).max():.2f} rad/s"
        )
        raise wrong("speed and turn rate", got=got, must="level")
    return Trim(_due_north(model, x, a, dt), a)


def _first_guess(model: Model, speed: Array, turn_rate: Array) -> tuple[Array, Array]:
    """Return a coordinated turn by the point-mass equations, at an angle of attack of 0.1 rad."""
    bank = np.arctan(speed * turn_rate / GRAVITY)
    attack = np.full_like(speed, 0.1)
    pitch = attack * np.cos(bank)
    guess = {
        "u": speed * np.cos(attack),
        "w": speed * np.sin(attack),
        "phi": bank,
        "theta": pitch,
        "p": -turn_rate * np.sin(pitch),
        "q": turn_rate * np.sin(bank) * np.cos(pitch),
        "r": turn_rate * np.cos(bank) * np.cos(pitch),
    }
    zero = np.zeros_like(speed)
    x = np.stack([guess.get(name, zero) for name in model.state_names], axis=1)
    a = np.stack([zero + 0.5 * (name == "throttle") for name in model.input_names], axis=1)
    return x, a


def _equations(
    model: Model, x: Array, a: Array, speed: Array, turn_rate: Array, dt: float
) -> tuple[Array, Array]:
    """Return the residuals (N, 12) and their derivative by the free states and inputs."""
    names = model.state_names
    free = [names.index(name) for name in FREE]
    rows = [names.index(name) for name in (*STEADY, "psi")]
    f_x, f_u = model.system.linearise(x, a, model.values, dt)
    rate = (model.system.step(x, a, model.values, dt) - x) / dt
    rate[:, names.index("psi")] -= turn_rate
    body = [names.index(name) for name in ("u", "v", "w")]
    V = np.sqrt((x[:, body] ** 2).sum(1))
    error = np.column_stack([rate[:, rows], V - speed, x[:, names.index("v")]])

    slope = np.zeros((len(x), 12, 12))
    by_state = (f_x - np.eye(len(names))) / dt
    slope[:, :10, :8] = by_state[:, rows][:, :, free]
    slope[:, :10, 8:] = f_u[:, rows] / dt
    slope[:, 10, :3] = x[:, body] / V[:, None]
    slope[:, 11, FREE.index("v")] = 1.0
    return error, slope


def _due_north(model: Model, x: Array, a: Array, dt: float) -> Array:
    """Turn each heading so that the track (not the nose) points north in the middle of the step."""
    names = model.state_names
    moved = model.system.step(x, a, model.values, dt)
    north, east, psi = (names.index(name) for name in ("north", "east", "psi"))
    track = np.arctan2(moved[:, east], moved[:, north]) - 0.5 * (moved[:, psi] - x[:, psi])
    x = x.copy()
    x[:, psi] -= track
    return x
