"""What arrives of the commands behind effects on inputs, and what was held before a trial.

Delays come last, together with the task's own latency: two shifts by parts of a step, one after the
other, are not the shift by both.
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
    """Commands (S, T, m) behind effects, in their order, and behind all delays."""
    latency = data.latency.copy()
    for effect, values in acting:
        if effect.family.name == "delay":
            latency[[data.model.input_names.index(n) for n in effect.site.targets]] += values["d"]
    return late_inputs(*_sent_on(acting, data), np.maximum(latency, 0.0), data.dt)


def _sent_on(acting: Acting, data: Data) -> tuple[Array, Array]:
    """The same before any delay, and what was held before (S, m)."""
    u, held = data.commands, data.held
    for effect, values in acting:
        if effect.family.name != "delay":
            u, held = _transformed(effect, values, u, held, data)
    return u, held


def memories_moved(acting: Acting, data: Data) -> Array:
    """What effects add to the memory states that runs begin with, (B, n).

    A lag that was adopted has settled at what a gain before it makes of the input that was held.
    Only the begin of a trial is known; zeros elsewhere.
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
    """Commands (S, T, m), and what was held before them (S, m), after an input or memory effect.

    What was held went through the effects before, too; a memory has settled at it.
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
