"""Values of the memory states of adopted effects, at the start of a trial and along it."""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded.compile.names import Named
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import true_values
from grounded.trial import Trial


def settled(model: Model, a: Named, p: Named) -> dict[str, Any]:
    """Return the settled memories of inputs under constant inputs a, by `input_family`."""
    found = getattr(model.step, "settled", None)
    return {} if found is None else dict(found(a, p))


def shifted(signal: Array, held: Array, steps: float) -> Array:
    """Delay a zero-order-hold signal (S, T) by any number of steps; return its mean over each."""
    whole = int(np.floor(steps + 1e-9))
    part = max(0.0, steps - whole)
    T = signal.shape[1]
    line = np.concatenate([np.repeat(held[:, None], whole + 1, axis=1), signal], axis=1)
    return (1 - part) * line[:, 1 : T + 1] + part * line[:, :T]


def lead_of_shift(signal: Array, held: Array, steps: float, lead: Array) -> Array:
    """Return how much more of a delayed signal (S, T) arrives early in each step than late.

    That is the mean of (1/2 - t/dt) u(t) over a step, 0 for one that is constant.

    Args:
        signal: zero-order-hold means of each step (S, T).
        held: the value before them (S,).
        steps: the delay, in steps.
        lead: the same of the signal itself (S, T).
    """
    part = max(0.0, steps - int(np.floor(steps + 1e-9)))
    whole = np.floor(steps + 1e-9)
    now, before = (shifted(signal, held, whole + more) for more in (0, 1))
    return 0.5 * part * (1 - part) * (before - now) + shifted(lead, 0 * held, steps)


def late_inputs(inputs: Array, held: Array, latency: Array, dt: float) -> Array:
    """Return inputs (S, T, m) after a latency (m,) [s], with `held` (S, m) before them."""
    if not latency.any():
        return inputs
    each = [shifted(inputs[:, :, j], held[:, j], d / dt) for j, d in enumerate(latency.tolist())]
    return np.stack(each, axis=2)


def memory_of(wrapped: Model, base: Model, trial: Trial, latency: Array | None = None) -> Array:
    """Return the memory states along a recorded trial, (T + 1, wrapped.n - base.n).

    They start at `memory_start` and follow the logged states and the received commands.

    Args:
        wrapped: the model with memory.
        base: the model without, whose states the trial has.
        trial: the trial; without `start_inputs`, 0 was held before it.
        latency: transport delay of the inputs (m,) [s], which acts before the memory; None: none.
    """
    inputs = trial.inputs
    if latency is not None:
        held = np.zeros(base.m) if trial.start_inputs is None else trial.start_inputs
        inputs = late_inputs(inputs[None], held[None], latency, trial.dt)[0]
    found = [now := memory_start(wrapped, base, trial)]
    for t in range(trial.steps):
        x = np.concatenate([trial.states[t], now])[None]
        after = wrapped.system.step(x, inputs[t][None], wrapped.values, trial.dt)
        now = after[0, base.n :]
        found.append(now)
    return np.array(found).reshape(trial.steps + 1, wrapped.n - base.n)


def memory_start(wrapped: Model, base: Model, trial: Trial) -> Array:
    """Return the memory states at t = 0, (wrapped.n - base.n,).

    A clock starts at 0, a true value behind a delayed log at the log. Memories of inputs start
    settled at the held inputs, after the input effects that act before them.
    """
    held = np.zeros(base.m) if trial.start_inputs is None else trial.start_inputs
    inputs = Named("input", base.input_names, list(held))
    params = Named("parameter", wrapped.param_names, list(wrapped.values))
    known = settled(wrapped, inputs, params)
    names, n = wrapped.state_names, base.n
    start = [float(known.get(name.rpartition("_")[0], 0.0)) for name in names[n:]]
    for memory, logged in true_values(names, names[n:]).items():
        start[memory - n] = float(trial.states[0, logged])
    return np.array(start)
