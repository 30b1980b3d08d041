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
from grounded.effects.memory import lead_of_shift, settled, shifted
from grounded.frozen import Array

WHOLE = 1e-9  # steps by which a latency may differ from a whole number
Acting = Sequence[tuple[Effect, Mapping[str, float]]]


def arriving(acting: Acting, data: Data, j: int) -> Array:
    """Return input j (S, T) received in the trials in use, after all effects on it and all delays.

    Effects on one input do not depend on the others, so each is computed and cached by itself.
    """
    late = _late(acting, data, j)
    sent, held, _ = _sent_on(acting, data, j)
    return shifted(sent, held, late / data.dt) if late > 0 else sent


def leading(acting: Acting, data: Data, j: int) -> Array:
    """Return how much more of input j arrives early in each step than late (`MemoryFamily.lead`).

    Shape (S, T), of the trials in use.
    """
    late = _late(acting, data, j)
    sent, held, lead = _sent_on(acting, data, j)
    return lead_of_shift(sent, held, late / data.dt, lead) if late > 0 else lead


def within_steps(acting: Acting, data: Data) -> bool:
    """Check whether an input may change within a step."""
    parts = np.abs(data.latency / data.dt - np.round(data.latency / data.dt))
    moving = (e.family for e, _ in acting if isinstance(e.family, MemoryFamily))
    return bool((parts > WHOLE).any()) or any(f.transport or f.lead is not None for f in moving)


def _late(acting: Acting, data: Data, j: int) -> float:
    """Return the delay of input j [s]: the task's own and that of all effects."""
    name, late = data.model.input_names[j], float(data.latency[j])
    for effect, values in acting:
        if effect.family.name == "delay" and name in effect.site.targets:
            late += values["d"]
    return late


def _sent_on(acting: Acting, data: Data, j: int) -> tuple[Array, Array, Array]:
    """Return input j (S, T) after all effects on it but delays, and that held before (S,).

    The third is its lead within each step (S, T), see `MemoryFamily`.
    """
    name = data.model.input_names[j]
    u, held = data.commands[data.used, :, j], data.held[data.used, j]
    lead = np.zeros_like(u)
    for effect, values in acting:
        if effect.family.name != "delay" and name in effect.site.targets:
            u, held, lead = _transformed(effect, values, (u, held, lead), data.dt)
    return u, held, lead


def memories_moved(acting: Acting, data: Data) -> Array:
    """Return what effects add to the memory states at the start of runs, (B, n).

    An adopted lag starts settled at the input held before the trial, and an effect that acts before
    it (a gain) changes that input. The result is zero for runs that do not begin a trial.
    """
    model, found = data.model, np.zeros((len(data.valid), data.model.n))
    held = data.held.copy()
    for j in range(model.m):
        held[data.used, j] = _sent_on(acting, data, j)[1]
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
    effect: Effect, values: Mapping[str, float], sent: tuple[Array, Array, Array], dt: float
) -> tuple[Array, Array, Array]:
    """Apply an input or memory effect to commands (S, T), the input held before (S,), and leads.

    A memory starts settled at the held input.
    """
    family, (u, held, lead) = effect.family, sent
    if isinstance(family, InputFamily):
        t = np.arange(u.shape[1]) * dt
        now = np.asarray(family.effect(u, t[None, :], values), float)
        before = np.asarray(family.effect(held, 0.0, values), float)
        more = np.asarray(family.effect(u + lead, t[None, :], values), float) if lead.any() else now
        return np.broadcast_to(now, u.shape), np.broadcast_to(before, held.shape), more - now
    if isinstance(family, MemoryFamily):
        z = family.along(u, held, values, dt)
        lead = np.zeros_like(u) if family.lead is None else family.lead(u, z, values, dt)
        u, _ = family.advance(u, (z,), values, dt)
    return u, held, lead
