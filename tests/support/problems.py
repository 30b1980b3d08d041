"""Small models, and tasks whose solution is known in closed form."""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded.compile import system_of
from grounded.compile.problem import Problem


def double_integrator(s, a, p):
    return {"x": s.v, "v": a.force / p.mass - p.drag * s.v}


def pendulum(s, a, p):
    return {"theta": s.omega, "omega": -p.g / p.l * np.sin(s.theta) - p.c * s.omega + a.torque}


def car(s, a, p):
    """A small car with actuator lags, a saturated throttle and a stall."""
    v_target = p.k_v * np.maximum(a.throttle - p.stall, 0.0)
    return {
        "delta": (p.k_d * a.steering + p.b_d - s.delta) / p.tau_d,
        "v": np.where(v_target > s.v, (v_target - s.v) / p.tau_v, -p.brake * np.tanh(s.v)),
        "x": s.v * np.cos(s.psi),
        "y": s.v * np.sin(s.psi),
        "psi": s.v / p.L * np.tan(s.delta),
    }


SPECS: dict[str, dict[str, Any]] = {
    "double_integrator": {
        "function": double_integrator,
        "states": ("x", "v"),
        "inputs": ("force",),
        "params": {"mass": 1.5, "drag": 0.1},
        "angles": (False, False),
    },
    "pendulum": {
        "function": pendulum,
        "states": ("theta", "omega"),
        "inputs": ("torque",),
        "params": {"g": 9.81, "l": 0.8, "c": 0.1},
        "angles": (True, False),
    },
    "car": {
        "function": car,
        "states": ("delta", "v", "x", "y", "psi"),
        "inputs": ("steering", "throttle"),
        "params": {
            "k_v": 3.0,
            "stall": 0.18,
            "k_d": 0.45,
            "b_d": 0.02,
            "tau_d": 0.1,
            "tau_v": 0.4,
            "brake": 0.5,
            "L": 0.15,
        },
        "angles": (False, False, False, False, True),
    },
}


def system(name: str, make=system_of, kind: str = "derivative", integrator: str = "rk4"):
    """Return the System of a named model and its parameter values (k,)."""
    spec = SPECS[name]
    made = make(
        spec["function"],
        kind=kind,
        states=spec["states"],
        inputs=spec["inputs"],
        params=tuple(spec["params"]),
        integrator=integrator,
    )
    return made, np.array(list(spec["params"].values()))


def plain(system: Any, p: Any, horizon: int, dt: float, **changes: Any) -> Problem:
    """Return a problem without limits, delays or bias: from rest to zero, with weights of one."""
    n, m, H = system.n, system.m, horizon
    fields: dict[str, Any] = {
        "start": np.zeros(n),
        "past": np.zeros(m),
        "delay": np.zeros(m),
        "bias": np.zeros((H, n)),
        "target": np.zeros((H + 1, n)),
        "state_weight": np.ones((H + 1, n)),
        "input_target": np.zeros((H, m)),
        "input_weight": np.ones(m),
        "change_weight": np.ones(m),
        "low": np.full(m, -np.inf),
        "high": np.full(m, np.inf),
        "angles": np.zeros(n, bool),
    }
    return Problem(system, p=p, dt=dt, **fields | changes)


def problem(name: str, horizon: int = 40, seed: int = 0, make=system_of, **changes: Any) -> Problem:
    """Return a tracking problem with random weights, targets and bias for a named model."""
    rng = np.random.default_rng(seed)
    sys, p = system(name, make)
    n, m, H = sys.n, sys.m, horizon
    fields: dict[str, Any] = {
        "start": rng.normal(size=n) * 0.3,
        "past": rng.normal(size=m) * 0.1,
        "bias": rng.normal(size=(H, n)) * 0.01,
        "target": rng.normal(size=(H + 1, n)) * 0.3,
        "state_weight": rng.uniform(0.5, 2.0, size=(H + 1, n)),
        "input_target": rng.normal(size=(H, m)) * 0.1,
        "input_weight": rng.uniform(0.1, 0.3, size=m),
        "change_weight": rng.uniform(0.1, 0.5, size=m),
        "angles": np.array(SPECS[name]["angles"]),
    }
    return plain(sys, p, H, 0.05, **fields | changes)


def linear_least_squares(problem: Problem):
    """Return (M, r) with J(u) = |M u - r|^2 of a problem with linear dynamics, by superposition."""
    H, m = problem.horizon, problem.system.m

    def residuals(u):
        run = problem.system.rollout(problem, u)
        z, u = run.z[0], run.u[0]
        change = np.diff(u, axis=0, prepend=problem.past[None])
        e = np.sqrt(problem.state_weight) * (z[:, : problem.system.n] - problem.target)
        return np.concatenate(
            [
                e.ravel(),
                (np.sqrt(problem.input_weight) * (u - problem.input_target)).ravel(),
                (np.sqrt(problem.change_weight) * change).ravel(),
            ]
        )

    base = residuals(np.zeros((H, m)))
    columns = []
    for i in range(H * m):
        unit = np.zeros(H * m)
        unit[i] = 1.0
        columns.append(residuals(unit.reshape(H, m)) - base)
    return np.array(columns).T, -base
