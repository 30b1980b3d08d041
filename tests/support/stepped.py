"""Runs of a robot under commands, by a model's own steps or by other rates, and trials of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from grounded.effects import Library, memory_of
from grounded.model import Model
from grounded.trial import Trial


def stepped(
    real: Model | Callable[[Any, Any], Any],
    inputs: Any,
    dt: float,
    start: Any = None,
    *,
    fine: int = 20,
    disturbed: Any = None,
    rng: Any = None,
) -> np.ndarray:
    """Return the states (T + 1, n) under inputs (T, m), from zero unless `start` (n,) is given.

    `real` is a model, which makes its own steps, or rates (x, u) -> dx/dt, which RK4 integrates in
    `fine` parts of a step. `disturbed` (n,) is the standard deviation of what each step adds.
    """
    inputs = np.asarray(inputs, float).reshape(len(inputs), -1)
    if isinstance(real, Model):
        path = [np.zeros(real.n) if start is None else np.array(start, float)]
    else:
        path = [np.array(start, float)]
    for u in inputs:
        x = path[-1]
        if isinstance(real, Model):
            x = real.system.step(x[None], u[None], real.values, dt)[0]
        else:
            x = _integrated(real, x, u, dt / fine, fine)
        path.append(x if disturbed is None else x + disturbed * rng.standard_normal(len(x)))
    return np.array(path)


def _integrated(rates: Callable[[Any, Any], Any], x: Any, u: Any, h: float, parts: int) -> Any:
    for _ in range(parts):
        k1 = rates(x, u)
        k2 = rates(x + h / 2 * k1, u)
        k3 = rates(x + h / 2 * k2, u)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(x + h * k3, u))
    return x


def logged(
    model: Model,
    states: Any,
    inputs: Any,
    dt: float,
    noise: Any = 0.0,
    rng: Any = None,
    **more: Any,
) -> Trial:
    """Return a trial of a model, with sensor noise (n,) and nothing sent before it."""
    noisy = np.asarray(states, float)
    if rng is not None:
        noisy = noisy + noise * rng.standard_normal(noisy.shape)
    sent = np.asarray(inputs, float).reshape(len(inputs), -1)
    more = {"start_inputs": np.zeros(model.m)} | more
    return Trial(noisy, sent, dt, model.state_names, model.input_names, **more)


def levels(rng: Any, count: int, length: int, size: float = 1.0, m: int = 1) -> np.ndarray:
    """Return random commands (count * length, m), each held for some steps."""
    return np.repeat(rng.uniform(-size, size, (count, m)), length, axis=0)


def slopes(f: Callable[[Any], Any], at: Any, size: Any = 1e-6) -> np.ndarray:
    """Return central differences of f by the last axis of `at`, as the last axis."""
    sizes = np.broadcast_to(size, np.shape(at)[-1:])
    steps = zip(np.diag(sizes), sizes, strict=True)
    return np.stack([(f(at + d) - f(at - d)) / (2 * h) for d, h in steps], axis=-1)


def library(*names: str) -> Library:
    """Return a library of a few families."""
    return Library(tuple(map(Library().family, names)))


def lifted(better: Model, model: Model, run: Trial) -> Trial:
    """Return a trial of a model with the memory of the effects that another one has more."""
    states = np.hstack([run.states, memory_of(better, model, run)])
    return replace(run, states=states, state_names=better.state_names)
