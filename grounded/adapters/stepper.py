"""Base class of the adapters: a step on arrays, called with named values.

Model calls `step(s, a, p, dt)` with one sample (numbers) or N samples (arrays (N,)) per name.
Libraries step arrays: states (N, n), inputs (N, m). `Stepper` converts between the two, for the
step and for its derivatives. What else a simulator knows, Model and its users look for by name on
its stepper: `limits`, `ranges`, `latency`, `body`, `inverse`, `differenced` (see `mujoco`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from grounded.frozen import Array
from grounded.model import Model


class Stepper:
    """Steps and derivatives computed on arrays; subclasses implement the computation."""

    def __init__(self, states: Iterable[str], inputs: Iterable[str], params: Iterable[str]) -> None:
        self.states, self.inputs, self.params = tuple(states), tuple(inputs), tuple(params)

    def __call__(
        self, s: Mapping[str, Any], a: Mapping[str, Any], p: Mapping[str, Any], dt: float
    ) -> dict[str, Any]:
        """Return the next state by name: numbers for one sample, arrays (N,) for N samples."""
        x, u, single = self._arrays(s, a)
        moved = self.advance(x, u, self._values(p), float(dt))
        columns = moved[0].tolist() if single else moved.T
        return dict(zip(self.states, columns, strict=True))

    def jacobian(
        self, s: Mapping[str, Any], a: Mapping[str, Any], p: Mapping[str, Any], dt: float
    ) -> tuple[Array, Array]:
        """Return f_x (N, n, n) and f_u (N, n, m), without the first axis for one sample."""
        x, u, single = self._arrays(s, a)
        f_x, f_u = self.derivatives(x, u, self._values(p), float(dt))
        return (f_x[0], f_u[0]) if single else (f_x, f_u)

    def advance(self, x: Array, u: Array, p: Array, dt: float) -> Array:
        """Return the next states (N, n) for states x (N, n), inputs u (N, m), parameters p (k,)."""
        raise NotImplementedError

    def derivatives(self, x: Array, u: Array, p: Array, dt: float) -> tuple[Array, Array]:
        """Return f_x (N, n, n) and f_u (N, n, m) at N samples."""
        raise NotImplementedError

    def _arrays(self, s: Mapping[str, Any], a: Mapping[str, Any]) -> tuple[Array, Array, bool]:
        """Return states (N, n), inputs (N, m), and whether they were plain numbers."""
        columns = [s[name] for name in self.states] + [a[name] for name in self.inputs]
        both = np.stack(np.broadcast_arrays(*(np.asarray(c, dtype=float) for c in columns)), -1)
        single = both.ndim == 1
        both = np.ascontiguousarray(both.reshape(-1, len(columns)))
        n = len(self.states)
        return np.ascontiguousarray(both[:, :n]), np.ascontiguousarray(both[:, n:]), single

    def _values(self, p: Mapping[str, Any]) -> Array:
        return np.array([float(p[name]) for name in self.params])


def model_of(stepper: Stepper, **fields: Any) -> Model:
    """Return the Model of a stepper, with its derivatives."""
    return Model(step=stepper, jacobian=stepper.jacobian, **fields)
