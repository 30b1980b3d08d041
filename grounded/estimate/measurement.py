"""Measurement: what the sensors show; NoiseStd: process and measurement noise.

    x_{t+1} = f(x_t, u_t) + w_t,  w ~ N(0, diag(process^2)),     y = H x + v,  v ~ N(0, diag(r^2))

The states themselves are measured, all or some. `grounded.estimate.likelihood` estimates the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.checks import known, wrong
from grounded.frozen import Array, readonly
from grounded.model import Model


@dataclass(frozen=True, eq=False)
class Measurement:
    """Which of n states the ny channels measure.

    Args:
        states: index of the state that each channel measures, (ny,).
        angles: whether the innovation of a channel wraps to [-pi, pi], (ny,).
        n: number of states.
    """

    states: tuple[int, ...]
    angles: tuple[bool, ...]
    n: int

    @property
    def ny(self) -> int:
        """Number of channels."""
        return len(self.states)

    @property
    def pick(self) -> Array:
        """The Jacobian of what is measured, (ny, n)."""
        return np.asarray(np.eye(self.n)[list(self.states)])

    def innovation(self, y: Array, x: Array) -> Array:
        """Return y (..., ny) minus the measured ones of states x (..., n), with angles wrapped."""
        e = y - x[..., list(self.states)]
        if any(self.angles):
            mask = np.array(self.angles)
            e[..., mask] -= 2 * np.pi * np.rint(e[..., mask] / (2 * np.pi))
        return np.asarray(e)


def of_states(model: Model, names: Sequence[str] | None = None) -> Measurement:
    """Return the measurement of the states themselves.

    Args:
        model: n states.
        names: the measured states; None for all.

    Raises:
        GroundedError: for a name that is not a state.
    """
    names = model.state_names if names is None else tuple(names)
    for name in names:
        known("state", [name], model.states, f"model '{model.name}'")
    index = tuple(model.state_names.index(name) for name in names)
    return Measurement(index, tuple(name in model.angles for name in names), model.n)


@dataclass(frozen=True, eq=False)
class NoiseStd:
    """Standard deviations of the noise, in the units of the states and of the channels.

    Args:
        process: process noise w over `dt`, (n,); over a step h it is process * sqrt(h / dt).
        measurement: measurement noise v, (ny,).
        dt: step that `process` refers to [s].

    Raises:
        GroundedError: if a value is negative or not finite, or a measurement noise is zero.
    """

    process: Array
    measurement: Array
    dt: float

    def __post_init__(self) -> None:
        for name in ("process", "measurement"):
            value = readonly(getattr(self, name))
            if value.ndim != 1 or not np.isfinite(value).all() or (value < 0).any():
                raise wrong(f"{name} noise", value, must="weights")
            object.__setattr__(self, name, value)
        if (self.measurement == 0).any():
            raise wrong("measurement noise", self.measurement, must="above")
