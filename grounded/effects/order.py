"""In which order several effects act: one rule for prediction, for probes, for adopted models.

    command -> input effects as they were claimed -> transport delays -> model -> sensor effects

A transport delay commutes with all that does not depend on time, so it may as well act last; there
a fraction of a step blends two samples of what is delivered, not two commands that a nonlinear
effect has yet to see. Of two effects the one that is wrapped LAST acts FIRST on a command, so
wrapping goes from the model outwards: parameters, limits of rates, rates, sensors, inputs.
"""

from __future__ import annotations

from collections.abc import Sequence

from grounded.effects.family import (
    Family,
    InputFamily,
    MemoryFamily,
    ParamFamily,
    RateFamily,
)


def acting_order(families: Sequence[Family]) -> list[int]:
    """Indices of the effects on inputs, the one that acts first on a command first."""
    own = [i for i, f in enumerate(families) if isinstance(f, InputFamily | MemoryFamily)]
    return sorted(own, key=lambda i: _transports(families[i]))


def wrapping_order(families: Sequence[Family]) -> list[int]:
    """Indices of all effects, the one that is wrapped first (the innermost) first."""
    inputs = acting_order(families)
    rest = [i for i in range(len(families)) if i not in inputs]
    return [*sorted(rest, key=lambda i: _depth(families[i])), *reversed(inputs)]


def _transports(family: Family) -> bool:
    return isinstance(family, MemoryFamily) and family.transport


def _depth(family: Family) -> int:
    if isinstance(family, ParamFamily):
        return 0
    if isinstance(family, RateFamily):
        return 1 if family.parts else 2
    return 3
