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
from grounded.effects.memory import Sent, part_of, settled, shifted, shifted_within
from grounded.frozen import Array

Acting = Sequence[tuple[Effect, Mapping[str, float]]]


def arriving(acting: Acting, data: Data, j: int, *, leads: bool) -> Array:
    """Return input j received in the trials in use, after all effects on it and all delays.

    Effects on one input do not depend on the others, so each is computed and cached by itself.

    Args:
        acting: effects on inputs with their values, in the order in which they act.
        data: the data.
        j: which input.
        leads: also return how much more of it arrives early in each step than late
            (`MemoryFamily.lead`).

    Returns:
        (1, S, T), or (2, S, T) with the leads.
    """
    steps = _late(acting, data, j) / data.dt
    sent = _sent_on(acting, data, j, steps)
    mean, led = sent.mean, sent.lead.any()
    within = shifted_within(sent, steps) if leads or led else None
    if within is not None and led:
        mean = within[0]
    elif steps > 0:
        mean = shifted(sent.mean, sent.held, steps)
    return np.stack([mean, within[1]] if leads and within is not None else [mean])


def within_steps(acting: Acting, data: Data) -> bool:
    """Check whether an input may change within a step."""
    moving = (e.family for e, _ in acting if isinstance(e.family, MemoryFamily))
    return data.late_within or any(f.transport or f.lead is not None for f in moving)


def delayed(acting: Acting, data: Data) -> Array | None:
    """Return the part of a step, 0 to 1, by which each input is late beyond whole steps.

    Shape (m,), or (M, m) if values are given by row. None if something else changes inputs within a
    step.
    """
    if any(getattr(effect.family, "lead", None) is not None for effect, _ in acting):
        return None
    late = [np.asarray(_late(acting, data, j)) / data.dt for j in range(data.model.m)]
    steps = np.stack(np.broadcast_arrays(*late), axis=-1)
    return np.asarray(part_of(steps))


def _late(acting: Acting, data: Data, j: int) -> float:
    """Return the delay of input j [s]: the task's own and that of all effects."""
    name, late = data.model.input_names[j], float(data.latency[j])
    for effect, values in acting:
        if effect.family.name == "delay" and name in effect.site.targets:
            late += values["d"]
    return late


def _sent_on(acting: Acting, data: Data, j: int, steps: float = 0.0) -> Sent:
    """Return input j after all effects on it but delays.

    steps: the delay to come, which the first part of each step (`Sent.early`) leaves in this step.
    """
    name, part = data.model.input_names[j], 1 - float(part_of(steps))
    u, held = data.commands[data.used, :, j], data.held[data.used, j]
    sent = Sent(u, held, np.zeros_like(u), u, np.zeros_like(u))
    for effect, values in acting:
        if effect.family.name != "delay" and name in effect.site.targets:
            sent = _transformed(effect, values, sent, data.dt, part)
    return sent


def memories_moved(acting: Acting, data: Data) -> Array:
    """Return what effects add to the memory states at the start of runs, (B, n).

    An adopted lag starts settled at the input held before the trial, and an effect that acts before
    it (a gain) changes that input. The result is zero for runs that do not begin a trial.
    """
    model, found = data.model, np.zeros((len(data.valid), data.model.n))
    held = data.held.copy()
    for j in range(model.m):
        held[data.used, j] = _sent_on(acting, data, j).held
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
    effect: Effect, values: Mapping[str, float], sent: Sent, dt: float, part: float
) -> Sent:
    """Apply an input or memory effect to a signal, whose early part is `part` of each step.

    A memory starts settled at the held input.
    """
    family, u = effect.family, sent.mean
    if isinstance(family, InputFamily):
        t = np.arange(u.shape[1])[None] * dt

        def through(u: Array, lead: Array) -> tuple[Array, Array]:
            now = np.broadcast_to(np.asarray(family.effect(u, t, values), float), u.shape)
            return now, (family.effect(u + lead, t, values) - now if lead.any() else lead)

        before = np.asarray(family.effect(sent.held, 0.0, values), float)
        held = np.broadcast_to(before, sent.held.shape)
        mean, lead = through(u, sent.lead)
        early = through(sent.early, sent.early_lead) if part < 1 else (mean, lead)
        return Sent(mean, held, lead, *early)
    if isinstance(family, MemoryFamily):
        z = family.along(u, sent.held, values, dt)

        def over(u: Array, dt: float) -> tuple[Array, Array]:
            lead = np.zeros_like(u) if family.lead is None else family.lead(u, z, values, dt)
            return family.advance(u, (z,), values, dt)[0], lead

        mean, lead = over(u, dt)
        early = over(sent.early, part * dt) if part < 1 else (mean, lead)
        return Sent(mean, sent.held, lead, *early)
    return sent
