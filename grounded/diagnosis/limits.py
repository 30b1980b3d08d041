"""What the data cannot tell, said before anything is claimed.

A state that never moved, an input that never changed, a single trial, a handful of steps: an effect
there may exist and can't be known, so it is not offered and the reader is told.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.diagnosis.data import Data
from grounded.effects import (
    Effect,
    InputFamily,
    LossFamily,
    MemoryFamily,
    RateFamily,
    SensorDelayFamily,
    SensorFamily,
    SensorLagFamily,
)

FEW_STEPS = 30


@dataclass(frozen=True)
class Limits:
    """What can't be known: sentences, and whether they forbid to name a cause."""

    sentences: tuple[str, ...]
    no_cause: bool


def limits(data: Data) -> Limits:
    """What the trials are too few or too quiet for."""
    found, no_cause = [], False
    if data.count < 2:
        found.append("one trial alone confirms nothing; run a second one")
        no_cause = True
    if data.steps < FEW_STEPS:
        found.append(
            f"{data.steps} steps in all are too few to tell an effect from noise; record "
            f"{FEW_STEPS} or more"
        )
        no_cause = True
    still = constant_inputs(data)
    for name in still:
        found.append(f"input {name} never changed, so nothing can be said of its actuator")
    if len(still) == data.model.m:
        no_cause = True
    unmoved = still_states(data)
    for name in unmoved:
        found.append(f"state {name} never moved, so nothing can be said of what acts on it")
    if data.skipped:
        found.append(f"{data.skipped} stretches of the trials were left out, to bound memory")
    empty = [n for i, n in enumerate(data.model.state_names) if not data.seen[..., i].any()]
    for name in empty:
        found.append(f"state {name} was never measured")
    if len(unmoved) + len(empty) + len(data.hidden) == data.model.n:
        no_cause = True
    return Limits(tuple(found), no_cause)


def constant_inputs(data: Data) -> list[str]:
    """Inputs that took one value in every trial."""
    names = data.model.input_names
    return [
        name
        for j, name in enumerate(names)
        if float(
            np.ptp(np.concatenate([data.commands[i, :T, j] for i, T in enumerate(data.lengths)]))
        )
        <= 1e-9 * max(data.scales.peak(name), 1e-12)
    ]


def still_states(data: Data) -> list[str]:
    """States that had one value in every trial: to the last digit, so no sensor of them lives."""
    found = []
    for i, name in enumerate(data.model.state_names):
        if i in data.hidden:
            continue
        values = data.states[np.isfinite(data.states[:, i]), i]
        if values.size and float(np.ptp(values)) <= 1e-9 * max(data.scales.peak(name), 1e-12):
            found.append(name)
    return found


def knowable(data: Data, effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """The effects that these data could show at all."""
    still, unmoved = set(constant_inputs(data)), set(still_states(data))
    dead = {n for i, n in enumerate(data.model.state_names) if not data.seen[..., i].any()}
    memory = {data.model.state_names[i] for i in data.hidden}
    kept = []
    for effect in effects:
        targets = {part for t in effect.site.targets for part in t.split("<-")}
        family = effect.family
        if targets & memory:
            continue
        if isinstance(family, InputFamily | MemoryFamily) and targets & still:
            continue
        if isinstance(family, RateFamily | LossFamily) and targets & unmoved:
            continue
        sensors = SensorFamily | SensorDelayFamily | SensorLagFamily
        if isinstance(family, sensors) and targets & (dead | unmoved):
            continue
        kept.append(effect)
    return tuple(kept)
