"""A Model from a JAX function, with JAX's own derivatives.

    from grounded.adapters import jax
    model = jax.model(step, states={"q": "rad", "w": "rad/s"}, inputs={"torque": "N m"})

where `step(x, u, p, dt)` takes arrays (n,), (m,), (k,) and a number and returns the next state,
(n,). JAX compiles it for each batch size, in double precision whatever JAX's default is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from grounded.adapters.stepper import Stepper, model_of
from grounded.errors import needs
from grounded.frozen import Array
from grounded.model import Model, Param


def model(
    step: Callable[..., Any],
    *,
    states: Mapping[str, str],
    inputs: Mapping[str, str],
    params: Mapping[str, Param] | None = None,
    **fields: Any,
) -> Model:
    """Return the Model of a JAX function.

    Args:
        step: function (x (n,), u (m,), p (k,), dt) -> next state (n,), traceable by JAX.
        states: unit by name, in the order of x.
        inputs: unit by name, in the order of u.
        params: `Param` by name, in the order of p.
        fields: other fields of `Model`: angles, roles, name ...

    Raises:
        GroundedError: if jax is not installed.
    """
    params = params or {}
    stepper = JaxStepper(step, states, inputs, params)
    names = {"states": states, "inputs": inputs, "params": params}
    return model_of(stepper, **{"name": "jax"} | names | fields)


class JaxStepper(Stepper):
    """Evaluates a JAX function on batches."""

    def __init__(self, step: Callable[..., Any], *names: Iterable[str]) -> None:
        super().__init__(*names)
        self.step = step
        self._prepare()

    def _prepare(self) -> None:
        jax = needs("jax")
        over = (0, 0, None, None)
        self._steps = jax.jit(jax.vmap(self.step, over))
        self._slopes = jax.jit(jax.vmap(jax.jacfwd(self.step, argnums=(0, 1)), over))

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k not in ("_steps", "_slopes")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._prepare()

    def advance(self, x: Array, u: Array, p: Array, dt: float) -> Array:
        """Return the next states (N, n)."""
        with _double():
            return np.array(self._steps(x, u, p, dt), dtype=float)

    def derivatives(self, x: Array, u: Array, p: Array, dt: float) -> tuple[Array, Array]:
        """Return f_x and f_u by forward-mode differentiation."""
        with _double():
            f_x, f_u = self._slopes(x, u, p, dt)
            return np.array(f_x, dtype=float), np.array(f_u, dtype=float)


def _double() -> Any:
    """Return a context with double precision; older JAX has the switch in `experimental`."""
    jax = needs("jax")
    if hasattr(jax, "enable_x64"):
        return jax.enable_x64(True)
    return needs("jax.experimental").enable_x64()
