"""Models from JAX and CasADi functions: the same numbers and derivatives as plain NumPy."""

from __future__ import annotations

import pickle
import sys
from typing import Any

import numpy as np
import pytest

from facts import holding
from grounded.adapters import casadi as casadi_adapter
from grounded.adapters import jax as jax_adapter
from grounded.adapters import mujoco as mujoco_adapter
from grounded.adapters.stepper import Stepper
from grounded.errors import GroundedError
from grounded.model import Model, Param

STATES, INPUTS = {"q": "rad", "w": "rad/s"}, {"torque": "N m"}
PARAMS = {"length": Param(0.5, "m", 0.1, 1.0), "drag": Param(0.1)}


def with_names(s: Any, a: Any, p: Any, dt: Any) -> dict[str, Any]:
    w = s.w + dt * (a.torque - 9.81 / p.length * np.sin(s.q) - p.drag * s.w)
    return {"q": s.q + dt * w, "w": w}


def with_arrays(x: Any, u: Any, p: Any, dt: Any) -> Any:
    import jax.numpy as jnp

    w = x[1] + dt * (u[0] - 9.81 / p[0] * jnp.sin(x[0]) - p[1] * x[1])
    return jnp.stack([x[0] + dt * w, w])


def casadi_function() -> Any:
    import casadi as ca

    x, u, p, dt = (ca.SX.sym(n, k) for n, k in (("x", 2), ("u", 1), ("p", 2), ("dt", 1)))
    w = x[1] + dt * (u - 9.81 / p[0] * ca.sin(x[0]) - p[1] * x[1])
    return ca.Function("pendulum", [x, u, p, dt], [ca.vertcat(x[0] + dt * w, w)])


def made(library: str) -> Model:
    pytest.importorskip(library, reason="an optional library of the adapters")
    fields: dict[str, Any] = {"states": STATES, "inputs": INPUTS, "params": PARAMS}
    if library == "jax":
        return jax_adapter.model(with_arrays, angles=("q",), **fields)
    return casadi_adapter.model(casadi_function(), angles=("q",), **fields)


@pytest.mark.parametrize("library", ["jax", "casadi"])
def test_steps_and_derivatives_are_those_of_the_plain_function(library: str) -> None:
    model = made(library)
    plain = Model(states=STATES, inputs=INPUTS, params=PARAMS, step=with_names)
    rng = np.random.default_rng(0)
    x, u, p = rng.normal(size=(7, 2)), rng.normal(size=(7, 1)), np.array([0.7, 0.2])
    np.testing.assert_allclose(
        model.system.step(x, u, p, 0.02), plain.system.step(x, u, p, 0.02), atol=1e-14
    )
    f_x, f_u = plain.system.linearise(x, u, p, 0.02)
    assert isinstance(model.step, Stepper)
    found = model.step.derivatives(x, u, p, 0.02)
    np.testing.assert_allclose(found[0], f_x, atol=1e-12)
    np.testing.assert_allclose(found[1], f_u, atol=1e-12)
    copied = pickle.loads(pickle.dumps(model.step))
    np.testing.assert_array_equal(copied.advance(x, u, p, 0.02), model.step.advance(x, u, p, 0.02))


def test_a_casadi_function_of_other_sizes_is_refused() -> None:
    pytest.importorskip("casadi", reason="an optional library of the adapters")
    with pytest.raises(GroundedError, match=holding("[3, 1]")):
        casadi_adapter.model(casadi_function(), states=STATES | {"z": "m"}, inputs=INPUTS)


@pytest.mark.parametrize("library", ["mujoco", "jax", "casadi"])
def test_a_library_that_is_missing_names_its_extra(
    library: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    fields: dict[str, Any] = {"states": STATES, "inputs": INPUTS, "params": PARAMS}
    with pytest.raises(GroundedError, match=rf"'\.\[{library}\]'"):
        if library == "mujoco":
            mujoco_adapter.model("<mujoco/>")
        elif library == "jax":
            jax_adapter.model(with_arrays, **fields)
        else:
            casadi_adapter.model(_Sized(), **fields)


class _Sized:
    """Looks like a casadi.Function of the right sizes."""

    def n_in(self) -> int:
        return 4

    def numel_in(self, i: int) -> int:
        return (2, 1, 2, 1)[i]

    def numel_out(self, i: int) -> int:
        return 2
