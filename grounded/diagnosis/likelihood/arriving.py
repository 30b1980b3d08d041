"""Inputs received after effects on inputs, and the inputs held before a trial.

All delays are applied last and added to the task's own latency, because two successive shifts by
fractions of a step differ from one shift by their sum.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from grounded.compile import Named
from grounded.diagnosis.likelihood.data import Data
from grounded.effects import Effect, InputFamily, MemoryFamily
from grounded.effects.memory import late_inputs, settled
from grounded.frozen import Array

Acting = Sequence[tuple[Effect, Mapping[str, float]]]


def arriving(acting: Acting, data: Data) -> Array:
    """Return the inputs (S, T, m) received after all effects, in their order, and all delays."""
    latency = data.latency.copy()
    for effect, values in acting:
        if effect.family.name == "delay":
            latency[[data.model.input_names.index(n) for n in effect.site.targets]] += values["d"]
    return late_inputs(*_sent_on(acting, data), np.maximum(latency, 0.0), data.dt)


def _sent_on(acting: Acting, data: Data) -> tuple[Array, Array]:
    """Return the inputs (S, T, m) after all effects but delays, and those held before (S, m)."""
    u, held = data.commands, data.held
    for effect, values in acting:
        if effect.family.name != "delay":
            u, held = _transformed(effect, values, u, held, data)
    return u, held


def memories_moved(acting: Acting, data: Data) -> Array:
    """Return what effects add to the memory states at the start of runs, (B, n).

    An adopted lag starts settled at the input held before the trial, and an effect that acts before
    it (a gain) changes that input. The result is zero for runs that do not begin a trial.
    """
    model, found = data.model, np.zeros((len(data.valid), data.model.n))
    _, held = _sent_on(acting, data)
    p = Named("parameter", model.param_names, list(model.values))
    before, after = (
        settled(model, Named("input", model.input_names, list(one.T)), p)
        for one in (data.held, held)
    )
    begins = np.isin(data.state_at[:, 0], np.cumsum([0, *(data.lengths + 1)]))
    for i in data.hidden:
        memory = model.state_names[i].rpartition("_")[0]
        if memory in after:
            moved = np.broadcast_to(after[memory] - before[memory], data.count)
            found[begins, i] = moved[data.trial_of[begins]]
    return found


def _transformed(
    effect: Effect, values: Mapping[str, float], u: Array, held: Array, data: Data
) -> tuple[Array, Array]:
    """Apply an input or memory effect to commands (S, T, m) and to the inputs held before (S, m).

    A memory starts settled at the held input.
    """
    family, names = effect.family, data.model.input_names
    out, before = u.copy(), held.copy()
    for target in effect.site.targets:
        j = names.index(target)
        if isinstance(family, InputFamily):
            t = np.arange(u.shape[1]) * data.dt
            out[:, :, j] = family.effect(u[:, :, j], t[None, :], values)
            before[:, j] = family.effect(held[:, j], 0.0, values)
        elif isinstance(family, MemoryFamily):
            z = family.along(u[:, :, j], held[:, j], values, data.dt)
            out[:, :, j], _ = family.advance(u[:, :, j], (z,), values, data.dt)
    return out, before
