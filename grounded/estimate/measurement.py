"""Measurement: the measurement function of the sensors; NoiseStd: process and measurement noise.

    x_{t+1} = f(x_t, u_t) + w_t,  w ~ N(0, diag(process^2)),     y = h(x) + v,  v ~ N(0, diag(r^2))

The states themselves are measured, all or some. `grounded.estimate.likelihood` estimates the noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from grounded.checks import known, wrong
from grounded.frozen import Array, readonly
from grounded.model import Model


@dataclass(frozen=True, eq=False)
class Measurement:
    """A measurement function y = h(x) with ny channels.

    Args:
        names: names of the channels.
        function: h, states (N, n) -> (N, ny).
        jacobian: h_x, (N, n) -> (N, ny, n).
        angles: whether the innovation of a channel wraps to [-pi, pi], (ny,).
        states: index of the state that a channel measures directly, -1 for none, (ny,).
    """

    names: tuple[str, ...]
    function: Callable[[Array], Array]
    jacobian: Callable[[Array], Array]
    angles: tuple[bool, ...]
    states: tuple[int, ...]

    @property
    def ny(self) -> int:
        """Number of channels."""
        return len(self.names)

    def innovation(self, y: Array, predicted: Array) -> Array:
        """Return the innovation y - predicted, (..., ny), with angles wrapped to [-pi, pi]."""
        e = y - predicted
        if any(self.angles):
            mask = np.array(self.angles)
            e[..., mask] -= 2 * np.pi * np.rint(e[..., mask] / (2 * np.pi))
        return e


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
    index = [model.state_names.index(name) for name in names]
    pick = np.eye(model.n)[index]
    return Measurement(
        names=names,
        function=lambda x: np.asarray(x[:, index]),
        jacobian=lambda x: np.broadcast_to(pick, (len(x), *pick.shape)),
        angles=tuple(name in model.angles for name in names),
        states=tuple(index),
    )


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
