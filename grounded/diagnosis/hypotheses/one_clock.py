"""Equivalence of delayed commands and delayed sensors in a time-invariant model.

If all sensors of the part that some inputs drive are delayed by d, y(t) = x(t - d), then
x' = f(x, u) becomes y' = f(y, u(t - d)), which are the equations for commands delayed by d. No run
can distinguish the two, unless the same clock stamps a command and its response.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from grounded import places
from grounded.effects import Effect
from grounded.model import Model

SLIGHT = 1e-9  # fraction of a step's largest slope that counts as no dependence
FAMILIES = {"delay": "sensor_delay", "sensor_delay": "delay"}


@dataclass(frozen=True)
class OneClock:
    """A claimed delay and the equivalent delay of the other side.

    Args:
        effect: name of the claimed effect.
        like: name of the equivalent effect.
        inputs: the inputs of the delayed part of the model.
        states: its states that have a sensor.
    """

    effect: str
    like: str
    inputs: tuple[str, ...]
    states: tuple[str, ...]


def one_clock(
    model: Model, effects: Sequence[Effect], shown: Sequence[str], still: Collection[str] = ()
) -> tuple[OneClock, ...]:
    """Find delays that cover all inputs, or all sensors, of an independent part of a model.

    Args:
        model: its structure defines the parts.
        effects: the claimed effects.
        shown: names of states that have a sensor.
        still: inputs that never changed, whose delay makes no difference.
    """
    moving = [name for name in model.input_names if name not in still]
    some = [e for e in effects if e.family.name in FAMILIES]
    parts = _parts(model) if some else []
    found = []
    for effect in some:
        targets = set(effect.site.targets)
        touched = [part for part in parts if targets & part]
        inputs = tuple(n for n in moving if any(n in part for part in touched))
        states = tuple(n for n in shown if any(n in part for part in touched))
        side, other = (inputs, states) if effect.family.name == "delay" else (states, inputs)
        if targets == set(side) and other:
            like = f"{FAMILIES[effect.family.name]}:{'+'.join(other)}"
            found.append(OneClock(effect.name, like, inputs, states))
    return tuple(found)


def _parts(model: Model) -> list[set[str]]:
    """Return the connected parts of a model, sets of states and inputs that are coupled."""
    dt = places.probe(model, 1e-2)
    f_x, f_u = model.system.linearise(*places.samples(model, 8), model.values, dt)
    slopes = np.abs(np.concatenate([f_x - np.eye(model.n), f_u], axis=-1)).max(axis=0)
    names = (*model.state_names, *model.input_names)
    parts = [{name} for name in names]
    for i, j in np.argwhere(slopes > SLIGHT * slopes.max()):
        one, other = (next(p for p in parts if names[k] in p) for k in (i, j))
        if one is not other:
            parts.remove(other)
            one |= other
    return parts
