"""The order in which several effects act, and are wrapped around a model (see `family`)."""

from __future__ import annotations

from collections.abc import Sequence

from grounded.effects.family import (
    Family,
    InputFamily,
    LossFamily,
    MediumFamily,
    MemoryFamily,
    ParamFamily,
    RateFamily,
    SensorDelayFamily,
    SensorLagFamily,
)


def acting_order(families: Sequence[Family]) -> list[int]:
    """Return the indices of the effects on inputs in the order in which they act on a command."""
    own = [i for i, f in enumerate(families) if isinstance(f, InputFamily | MemoryFamily)]
    return sorted(own, key=lambda i: getattr(families[i], "transport", False))


def joining_order(old: Sequence[Family], new: Sequence[Family]) -> list[tuple[bool, int]]:
    """Return the order of old and new effects, as pairs (whether new, index).

    New effects were fitted on the model with the old ones. On commands they act before the old
    ones, otherwise after them.
    """
    first = [i for i, f in enumerate(new) if isinstance(f, InputFamily | MemoryFamily)]
    last = [i for i in range(len(new)) if i not in first]
    return [
        *((True, i) for i in first),
        *((False, i) for i in range(len(old))),
        *((True, i) for i in last),
    ]


def wrapping_order(families: Sequence[Family]) -> list[int]:
    """Return the indices of all effects in wrapping order, the innermost first."""
    inputs = acting_order(families)
    rest = [i for i in range(len(families)) if i not in inputs]
    return [*sorted(rest, key=lambda i: _depth(families[i])), *reversed(inputs)]


def _depth(family: Family) -> float:
    if isinstance(family, ParamFamily | LossFamily):
        return 0 if isinstance(family, ParamFamily) else 1
    if isinstance(family, MediumFamily):
        return 3.5
    if isinstance(family, RateFamily):
        return 2 if family.parts else 3
    if isinstance(family, SensorDelayFamily | SensorLagFamily):  # their memories start at the log
        return 5 if isinstance(family, SensorDelayFamily) else 6
    return 4
