"""Helpers of the peers' scripts: a case's arrays, its model, and how to report.

The aircraft is `grounded.models.aircraft`; the car is `grounded.models.car` without its stall and
its braking, so that every solver sees smooth functions.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
from collections.abc import Callable
from types import ModuleType, SimpleNamespace

import numpy as np

from grounded.models import aircraft, car

CLOSE = 1e-4  # relative distance from the best known cost at which a solver is done


def load(xp: ModuleType) -> SimpleNamespace:
    """Load the case of the command line: argv[1] is the file, argv[2] the best cost.

    Args:
        xp: the module whose functions the model calls.
    """
    data = dict(np.load(sys.argv[1]))
    case = SimpleNamespace(**data, best=float(sys.argv[2]))
    case.name, case.dt = str(case.name), float(case.dt)
    case.rate = rate_of(case.name, xp)
    case.H, case.m = case.u.shape
    case.n = len(case.start)
    case.repeats = 1 if case.name == "aircraft" else 3  # of a slow peer's timing
    return case


def reached(case: SimpleNamespace, cost: float) -> bool:
    """Check whether a cost counts as the best known."""
    return cost <= case.best * (1 + CLOSE)


def fastest(function: Callable[[], object], repeats: int) -> float:
    """Return the least CPU seconds of a few calls."""
    times = []
    for _ in range(repeats):
        start = sum(os.times()[:4])  # logs are read in a child process
        function()
        times.append(sum(os.times()[:4]) - start)
    return min(times)


def report(**values: object) -> None:
    """Print one JSON line on stdout."""
    print(json.dumps(values))


def smooth_dynamics(s, a, p):
    delta_dot = (p.a1 * a.steering + p.b1 - s.delta) / p.tau_delta
    v_dot = (p.a2 * a.throttle + p.b2 - s.v) / p.tau_v
    cd, sd = np.cos(s.delta), np.sin(s.delta)
    return {
        "delta": delta_dot,
        "v": v_dot,
        "x": s.v * cd * np.cos(s.psi),
        "y": s.v * cd * np.sin(s.psi),
        "psi": s.v * sd / p.L,
        "psi_rate": (v_dot * sd + s.v * cd * delta_dot) / p.L,
    }


SMOOTH = ("a1", "b1", "a2", "b2", "tau_delta", "tau_v", "L")
MODELS = {
    "car": dataclasses.replace(
        car.model,
        name="smooth car",
        params={name: car.model.params[name] for name in SMOOTH},
        derivative=smooth_dynamics,
    ),
    "aircraft": aircraft.model,
}


def rate_of(name, xp):
    """Return a model's ds/dt on lists x, u, p of numbers, arrays or symbols; its `np` is xp."""
    model = MODELS[name]
    model.derivative.__globals__["np"] = xp

    def named(names, values):
        return SimpleNamespace(**dict(zip(names, values, strict=True)))

    def rate(x, u, p):
        values = model.derivative(
            named(model.states, x), named(model.inputs, u), named(model.params, p)
        )
        return [values[state] for state in model.states]

    return rate


def rk4(rate, x, u, p, dt):
    """Take one Runge-Kutta step with lists."""

    def moved(k, h):
        return [a + h * b for a, b in zip(x, k, strict=True)]

    k1 = rate(x, u, p)
    k2 = rate(moved(k1, dt / 2), u, p)
    k3 = rate(moved(k2, dt / 2), u, p)
    k4 = rate(moved(k3, dt), u, p)
    return [
        a + dt / 6 * (b + 2 * c + 2 * d + e)
        for a, b, c, d, e in zip(x, k1, k2, k3, k4, strict=True)
    ]
