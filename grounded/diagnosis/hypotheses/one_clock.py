"""Late commands and late sensors: one thing to any model that no clock enters.

If every sensor of what some inputs drive shows d ago, y(t) = x(t - d), then x' = f(x, u) is
y' = f(y, u(t - d)): the very equations of commands that arrive d late. No run tells which it is,
unless one clock stamps a command and what it did.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.effects import Effect, places
from grounded.model import Model

SLIGHT = 1e-9  # of a step's largest slope: no dependence
FAMILIES = {"delay": "sensor_delay", "sensor_delay": "delay"}


@dataclass(frozen=True)
class OneClock:
    """A claimed delay, and the other side that may be late instead.

    Args:
        effect: as it is claimed.
        like: the effect of the other side.
        inputs: those that drive what is late.
        states: all of it that has a sensor.
        whole: that is every sensor and every input.
    """

    effect: str
    like: str
    inputs: tuple[str, ...]
    states: tuple[str, ...]
    whole: bool

    def sentence(self) -> str:
        """What a person should know of it."""
        commands = "the commands" if self.whole else f"the commands of {_and(self.inputs)}"
        sensors = "all sensors" if self.whole else f"the sensors of {_and(self.states)}"
        return (
            f"A delay of {commands} cannot be told from one of {sensors} in a log; plans are the "
            "same for both."
        )


def one_clock(
    model: Model, effects: Sequence[Effect], shown: Sequence[str]
) -> tuple[OneClock, ...]:
    """Of each delay among effects that holds for all inputs of a part of a model, or all sensors.

    Args:
        model: whose structure tells its parts.
        effects: claimed ones.
        shown: states that a sensor has.
    """
    some = [e for e in effects if e.family.name in FAMILIES]
    parts = _parts(model) if some else []
    found = []
    for effect in some:
        targets = set(effect.site.targets)
        touched = [part for part in parts if targets & part]
        inputs = tuple(n for n in model.input_names if any(n in part for part in touched))
        states = tuple(n for n in shown if any(n in part for part in touched))
        side, other = (inputs, states) if effect.family.name == "delay" else (states, inputs)
        if targets == set(side) and other:
            like = f"{FAMILIES[effect.family.name]}:{'+'.join(other)}"
            whole = len(inputs) == model.m and len(states) == len(shown)
            found.append(OneClock(effect.name, like, inputs, states, whole))
    return tuple(found)


def _parts(model: Model) -> list[set[str]]:
    """States and inputs that hang together, each with what it drives or is driven by."""
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


def _and(names: Sequence[str]) -> str:
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last
