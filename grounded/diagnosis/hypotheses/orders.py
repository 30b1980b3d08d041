"""Other orders in which the effects of a hypothesis act on a command.

An effect that is added acts last, on what those found before it leave of the command. A rate limit
before a gain that fades, or a dead zone before an offset, is something else than after it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects import acting_order

MATTERS = 1e-3  # rms change of an input, relative to its spread, from which the order matters


def orders(predictor: Predictor, h: Hypothesis) -> list[Hypothesis]:
    """Return a hypothesis with one of its effects on inputs moved to another place in their order.

    Orders in which all inputs arrive nearly as in another one are left out: effects on different
    inputs, or ones that commute.
    """
    acting = acting_order([effect.family for effect in h.effects])
    places = [(i, at) for i in acting for at in range(len(acting))]
    return _different(predictor, h, acting, places)


def first(predictor: Predictor, h: Hypothesis) -> list[Hypothesis]:
    """Return a hypothesis with its latest effect acting first, if that changes an input."""
    latest = len(h.effects) - 1
    acting = acting_order([effect.family for effect in h.effects])
    places = [(latest, 0)] if latest in acting and latest else []
    return _different(predictor, h, acting, places)


def _different(
    predictor: Predictor,
    h: Hypothesis,
    acting: Sequence[int],
    places: Sequence[tuple[int, int]],
) -> list[Hypothesis]:
    """Return the hypotheses in which effect i acts at another place, if inputs then differ.

    acting: the effects on inputs, in the order in which they act.
    """
    if len(acting) < 2 or not places:
        return []
    u = predictor.inputs(h)
    known, least = [u], MATTERS * np.maximum(u.std(axis=(0, 1)), 1e-12)
    found = []
    for i, at in places:
        rest = [j for j in acting if j != i]
        other = _in_order(h, [*rest[:at], i, *rest[at:]])
        u = predictor.inputs(other)
        apart = [np.sqrt(((u - v) ** 2).mean(axis=(0, 1))) for v in known]
        if all((a > least).any() for a in apart):
            known.append(u)
            found.append(other)
    return found


def _in_order(h: Hypothesis, acting: Sequence[int]) -> Hypothesis:
    """Return a hypothesis with its effects on inputs in another order, the others in place."""
    places = iter(acting)
    order = [next(places) if i in acting else i for i in range(len(h.effects))]
    return replace(
        h, effects=tuple(h.effects[i] for i in order), values=tuple(h.values[i] for i in order)
    )
