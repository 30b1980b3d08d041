"""Credit of each cause: the loss of accuracy without it, with the others fitted again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from grounded.diagnosis.validation.decide import Decision
from grounded.diagnosis.validation.ruler import Ruler


def losses(ruler: Ruler, decision: Decision) -> dict[str, float]:
    """Return by how much the log error grows without each cause, in the mean."""
    without = decision.without.items()
    return {name: max(ruler.gain(fit, decision.fit).mean, 0.0) for name, fit in without}


def shares(ruler: Ruler, decision: Decision, lost: Mapping[str, float]) -> dict[str, float]:
    """Return the share of the total gain (in log error) that is lost without each cause.

    If causes overlap, the shares sum to less than 1. If they depend on one another, so that the
    losses sum to more than the total gain, the shares are normalised to 1.
    """
    whole = ruler.gain(decision.crude, decision.fit).mean
    return {name: loss / max(whole, sum(lost.values()), 1e-12) for name, loss in lost.items()}


def ordered(shares_: dict[str, float], names: Sequence[str]) -> list[str]:
    """Return names by their credit, largest first."""
    return sorted(names, key=lambda name: -shares_.get(name, 0.0))
