"""In which order several effects act, and are wrapped around a model (`family`, its last lines)."""

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
    """Indices of the effects on inputs, the one that acts first on a command first."""
    own = [i for i, f in enumerate(families) if isinstance(f, InputFamily | MemoryFamily)]
    return sorted(own, key=lambda i: getattr(families[i], "transport", False))


def joining_order(old: Sequence[Family], new: Sequence[Family]) -> list[tuple[bool, int]]:
    """The order in which new effects join a model that has others: (whether new, which one).

    They were fitted on the model with the old ones in it: on commands they act before these, on all
    else after them.
    """
    first = [i for i, f in enumerate(new) if isinstance(f, InputFamily | MemoryFamily)]
    last = [i for i in range(len(new)) if i not in first]
    return [
        *((True, i) for i in first),
        *((False, i) for i in range(len(old))),
        *((True, i) for i in last),
    ]


def wrapping_order(families: Sequence[Family]) -> list[int]:
    """Indices of all effects, the one that is wrapped first (the innermost) first."""
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
    if isinstance(family, SensorDelayFamily | SensorLagFamily):  # their memories begin at the log
        return 5 if isinstance(family, SensorDelayFamily) else 6
    return 4
