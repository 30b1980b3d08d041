"""A policy class with a few named parameters, as numbers: u_t = pi(x_t, theta, t).

The user writes `policy(s, theta, t) -> inputs by name` in plain NumPy, t in seconds. It is traced
like a model, which gives pi_x and pi_theta exactly; one that can't be traced is called and
differenced, sample by sample.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from grounded.compile.problem import Array
from grounded.compile.run.differenced import RELATIVE_STEP, DifferencedSystem
from grounded.compile.trace.tracing import (
    Signature,
    Trace,
    Variant,
    leaves_of,
    trace,
    values_and_jacobian,
)

NO_STEP = 1.0  # dt, which a policy does not see


class ParametricPolicy:
    """m inputs as a function of n states, k parameters and time.

    Args:
        function: policy(s, theta, t) -> {input: value}.
        states: names in array order; likewise `inputs` and `parameters`.
        inputs: see `states`.
        parameters: see `states`.

    Raises:
        GroundedError: for wrong names, naming the function's file and line.
    """

    def __init__(
        self,
        function: Callable[..., Mapping[str, Any]],
        states: Sequence[str],
        inputs: Sequence[str],
        parameters: Sequence[str],
    ) -> None:
        def called(s: Any, a: Any, p: Any) -> Mapping[str, Any]:
            return function(s, p, a.t)

        called.__wrapped__ = function  # type: ignore[attr-defined]
        self.n, self.m, self.k = len(states), len(inputs), len(parameters)
        self._signature = Signature(
            called, "derivative", tuple(states), ("t",), tuple(parameters), tuple(inputs)
        )
        self._plain = DifferencedSystem(
            called,
            kind="derivative",  # called without dt; `evaluate` is all that is used
            states=states,
            inputs=("t",),
            params=parameters,
            returns=inputs,
        )
        found = trace(self._signature, None, NO_STEP)
        self.note = found if isinstance(found, str) else ""
        usable = isinstance(found, Trace) and not found.guards
        self._variant = Variant(found, (self.n, 1, self.k)) if usable else None  # type: ignore[arg-type]

    def inputs(self, x: Array, t: Array, theta: Array) -> Array:
        """U (N, m) at x (N, n), times t (N,) [s], theta (k,)."""
        if self._variant is None:
            return self._plain.evaluate(x, t[:, None], theta, NO_STEP, 0.0)
        values = self._variant.values(leaves_of(x, t[:, None], theta, NO_STEP), 0.0)
        return np.stack([np.broadcast_to(v, len(x)) for v in values], axis=1)

    def derivatives(self, x: Array, t: Array, theta: Array) -> tuple[Array, Array]:
        """pi_x (N, m, n) and pi_theta (N, m, k)."""
        if self._variant is None:
            return self._differenced(x, t, theta)
        leaves = leaves_of(x, t[:, None], theta, NO_STEP)
        width = self.n + 1 + self.k
        _, J = values_and_jacobian(self._variant.full, leaves, 0.0, len(x), width)
        return J[:, :, : self.n], J[:, :, self.n + 1 :]

    def _differenced(self, x: Array, t: Array, theta: Array) -> tuple[Array, Array]:
        columns = []
        for i in range(self.n + self.k):
            ends = []
            for side in (1.0, -1.0):
                moved_x, moved_theta = x.copy(), theta.copy()
                if i < self.n:
                    moved_x[:, i] += side * RELATIVE_STEP
                else:
                    moved_theta[i - self.n] += side * RELATIVE_STEP
                ends.append(self.inputs(moved_x, t, moved_theta))
            columns.append((ends[0] - ends[1]) / (2 * RELATIVE_STEP))
        J = np.stack(columns, axis=2)
        return J[:, :, : self.n], J[:, :, self.n :]
