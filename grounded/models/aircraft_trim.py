"""Trim: states and inputs of an aircraft in steady level flight, straight or turning.

Level flight at airspeed V and turn rate omega without sideslip: twelve equations for the eight
states u, v, w, phi, theta, p, q, r and the four inputs (Stevens & Lewis 2003, section 3.6; the
turn is coordinated by beta = 0),

    u' = v' = w' = phi' = theta' = p' = q' = r' = altitude' = 0,  psi' = omega,  |V| = V,  v = 0,

solved for the discrete model, x_{t+1} - x_t over one control step, so that the trim is exact in the
simulation and works for any model with an aircraft's states, including adopted effects.
"""

from __future__ import annotations

import numpy as np

from grounded.checks import known, wrong
from grounded.frozen import Array
from grounded.model import Model

GRAVITY, ATTACK = 9.81, 0.1  # [m/s2, rad] of the first guess
STEADY = ("u", "v", "w", "phi", "theta", "p", "q", "r", "altitude", "psi")


def level_trim(
    model: Model, speed: float, turn_rate: float = 0.0, dt: float = 0.02
) -> tuple[Array, Array]:
    """Return states (12,) at the origin with a track due north, and inputs (4,), of level flight.

    Args:
        model: a model with the state and input names of `grounded.models.aircraft`.
        speed: airspeed V [m/s].
        turn_rate: omega [rad/s], positive to the right.
        dt: control step [s].

    Raises:
        GroundedError: if the model is not an aircraft, or a condition has no trim.
    """
    from scipy.optimize import root  # a fifth of a second

    names = model.state_names
    known("state", [*STEADY, "north", "east"], names, f"model '{model.name}'")
    rows = [names.index(name) for name in STEADY]
    free, psi, n = rows[:8], rows[9], 8
    # a coordinated turn by the point-mass equations
    bank = np.arctan(speed * turn_rate / GRAVITY)
    pitch = ATTACK * np.cos(bank)
    guess = {
        "u": speed * np.cos(ATTACK),
        "w": speed * np.sin(ATTACK),
        "phi": bank,
        "theta": pitch,
        "p": -turn_rate * np.sin(pitch),
        "q": turn_rate * np.sin(bank) * np.cos(pitch),
        "r": turn_rate * np.cos(bank) * np.cos(pitch),
    }
    x = np.array([guess.get(name, 0.0) for name in names])
    a = np.array([0.5 * (name == "throttle") for name in model.input_names])

    def moved() -> Array:
        return np.asarray(model.system.step(x[None], a[None], model.values, dt)[0])

    def unmet(unknown: Array) -> Array:
        x[free], a[:] = unknown[:n], unknown[n:]
        rate = (moved() - x) / dt
        rate[psi] -= turn_rate
        return np.array([*rate[rows], np.linalg.norm(x[free[:3]]) - speed, x[free[1]]])

    with np.errstate(all="ignore"):
        left = unmet(root(unmet, np.append(x[free], a), tol=1e-13).x)
    if not np.abs(left).max() < 1e-6:
        got = f"{speed:.2f} m/s, {turn_rate:.2f} rad/s"
        raise wrong("speed and turn rate", got=got, must="level")
    # the track, not the nose, points north in the middle of the step
    after, north, east = moved(), names.index("north"), names.index("east")
    x[psi] -= np.arctan2(after[east], after[north]) - 0.5 * (after[psi] - x[psi])
    return x, a
