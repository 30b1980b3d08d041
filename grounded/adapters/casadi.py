"""A Model from a CasADi function, with CasADi's own derivatives.

    from grounded.adapters import casadi
    model = casadi.model(function, states={"q": "rad", "w": "rad/s"}, inputs={"torque": "N m"})

where `function` is a `casadi.Function` of (x, u), (x, u, p) or (x, u, p, dt) that returns the next
state, columns of n, m and k numbers. A function without dt is taken to step one control interval.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from grounded.adapters.stepper import Stepper, model_of
from grounded.checks import refused
from grounded.errors import needs
from grounded.frozen import Array
from grounded.model import Model, Param


def model(
    function: Any,
    *,
    states: Mapping[str, str],
    inputs: Mapping[str, str],
    params: Mapping[str, Param] | None = None,
    **fields: Any,
) -> Model:
    """Return the Model of a CasADi function.

    Args:
        function: casadi.Function of x (n), u (m) [, p (k) [, dt]] -> next state (n).
        states: unit by name, in the order of x.
        inputs: unit by name, in the order of u.
        params: `Param` by name, in the order of p.
        fields: other fields of `Model`: angles, roles, name ...

    Raises:
        GroundedError: if casadi is not installed, or the function's sizes do not match the names.
    """
    params = params or {}
    found = [function.numel_in(i) for i in range(function.n_in())]
    wanted = [len(states), len(inputs), len(params), 1]
    short = 2 if not params else 3
    if found not in (wanted[:short], wanted[:3], wanted) or function.numel_out(0) != len(states):
        sizes = {"theirs": f"{found} -> {function.numel_out(0)}"}
        sizes["own"] = f"{wanted[:short]} -> {len(states)}"
        raise refused("given.fit", function.name(), what="sizes", **sizes)
    stepper = CasadiStepper(function, states, inputs, params)
    names = {"states": states, "inputs": inputs, "params": params}
    return model_of(stepper, **{"name": "casadi"} | names | fields)


class CasadiStepper(Stepper):
    """Evaluates a CasADi function on batches."""

    def __init__(self, function: Any, *names: Iterable[str]) -> None:
        super().__init__(*names)
        self.function = function
        ca = needs("casadi")
        given = [ca.MX.sym(f"i{i}", function.sparsity_in(i)) for i in range(function.n_in())]
        moved = function(*given)
        slopes = [ca.densify(ca.jacobian(moved, given[i])) for i in (0, 1)]
        self._slopes = ca.Function("slopes", given, slopes)

    def advance(self, x: Array, u: Array, p: Array, dt: float) -> Array:
        """Return the next states (N, n)."""
        moved = self.function.map(len(x))(*self._given(x, u, p, dt))
        return np.ascontiguousarray(np.array(moved, dtype=float).T)

    def derivatives(self, x: Array, u: Array, p: Array, dt: float) -> tuple[Array, Array]:
        """Return f_x and f_u by algorithmic differentiation."""
        N, n = x.shape
        found = self._slopes.map(N)(*self._given(x, u, p, dt))  # N blocks (n, ...) side by side
        f_x, f_u = (
            np.ascontiguousarray(np.array(f, dtype=float).reshape(n, N, -1).swapaxes(0, 1))
            for f in found
        )
        return f_x, f_u

    def _given(self, x: Array, u: Array, p: Array, dt: float) -> list[Any]:
        N = len(x)
        columns = [x.T, u.T, np.tile(p[:, None], (1, N)), np.full((1, N), dt)]
        return columns[: self.function.n_in()]
