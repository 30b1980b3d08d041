"""The memory states of a wrapped model along a recorded trial, where no sensor measured them."""

from __future__ import annotations

import numpy as np

from grounded.frozen import Array
from grounded.model import Model
from grounded.trial import Trial


def memory_of(wrapped: Model, base: Model, trial: Trial) -> Array:
    """The memory states along a recorded trial, (T + 1, wrapped.n - base.n).

    They start at what held before t = 0 (the held input, the first logged value, a clock at zero)
    and follow the commands and the logged states.
    """
    extra = wrapped.state_names[base.n :]
    now = memory_start(wrapped, base, trial)
    found = [now]
    for t in range(trial.steps):
        x = np.concatenate([trial.states[t], now])[None]
        after = wrapped.system.step(x, trial.inputs[t][None], wrapped.values, trial.dt)
        now = after[0, base.n :]
        found.append(now)
    return np.array(found).reshape(trial.steps + 1, len(extra))


def memory_start(wrapped: Model, base: Model, trial: Trial) -> Array:
    """The memory states at t = 0, (wrapped.n - base.n,)."""
    held = np.zeros(base.m) if trial.start_inputs is None else trial.start_inputs
    start = []
    for name in wrapped.state_names[base.n :]:
        inputs = [i for i, n in enumerate(base.input_names) if name.startswith(f"{n}_")]
        states = [i for i, n in enumerate(base.state_names) if name.startswith(f"{n}_true")]
        if name.endswith("_clock"):
            start.append(0.0)
        elif states:
            start.append(float(trial.states[0, states[-1]]))
        else:
            start.append(float(held[inputs[-1]]) if inputs else 0.0)
    return np.array(start)
