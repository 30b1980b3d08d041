"""Trim: states and inputs of an aircraft in steady level flight, straight or turning.

Level flight at airspeed V and turn rate omega without sideslip: twelve equations for the eight
states u, v, w, phi, theta, p, q, r and the four inputs (Stevens & Lewis 2003, section 3.6; the
turn is coordinated by beta = 0),

    u' = v' = w' = phi' = theta' = p' = q' = r' = altitude' = 0,  psi' = omega,  |V| = V,  v = 0,

solved for the discrete model, x_{t+1} - x_t over one control step, so that the trim is exact in the
simulation and works for any model with an aircraft's states, including adopted effects.
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
    from scipy.optimize import root  # a fifth of a second

    speed, turn_rate = np.broadcast_arrays(np.atleast_1d(speed), np.atleast_1d(turn_rate))
    names = model.state_names
    known("state", [*FREE, "north", "east", "altitude", "psi"], names, f"model '{model.name}'")
    x, a = _first_guess(model, speed, turn_rate)
    free, n = [names.index(name) for name in FREE], len(FREE)
    rows = [names.index(name) for name in (*STEADY, "psi")]
    body, psi = [names.index(name) for name in ("u", "v", "w")], names.index("psi")
    worst = 0.0
    for k, (V, omega) in enumerate(zip(speed.tolist(), turn_rate.tolist(), strict=True)):

        def unmet(unknown: Array, k: int = k, V: float = V, omega: float = omega) -> Array:
            x[k, free], a[k] = unknown[:n], unknown[n:]
            rate = (model.system.step(x[k : k + 1], a[k : k + 1], model.values, dt)[0] - x[k]) / dt
            rate[psi] -= omega
            return np.array([*rate[rows], np.linalg.norm(x[k, body]) - V, x[k, names.index("v")]])

        with np.errstate(all="ignore"):
            found = root(unmet, np.append(x[k, free], a[k]), tol=1e-13).x
            worst = max(worst, float(np.nan_to_num(np.abs(unmet(found)).max(), nan=np.inf)))
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


def _due_north(model: Model, x: Array, a: Array, dt: float) -> Array:
    """Turn each heading so that the track (not the nose) points north in the middle of the step."""
    names = model.state_names
    moved = model.system.step(x, a, model.values, dt)
    north, east, psi = (names.index(name) for name in ("north", "east", "psi"))
    track = np.arctan2(moved[:, east], moved[:, north]) - 0.5 * (moved[:, psi] - x[:, psi])
    x = x.copy()
    x[:, psi] -= track
    return x
