"""A hypothesis: effects with their values, and shifts of the model's parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from grounded.effects import (
    Effect,
    LossFamily,
    MediumFamily,
    RateFamily,
    SensorDelayFamily,
    SensorFamily,
    SensorLagFamily,
    acting_order,
)
from grounded.frozen import Array


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Effects with their values, and shifts of the model's parameters (k,) with a prior.

    `spread` is the prior standard deviation of every shift in units of `Model.spreads`, which the
    user gives; 0: the parameters are exact.
    """

    effects: tuple[Effect, ...] = ()
    values: tuple[Mapping[str, float], ...] = ()
    shift: Array | None = None
    spread: float = 0.0

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The effects' names."""
        return tuple(effect.name for effect in self.effects)

    @cached_property
    def pairs(self) -> list[tuple[Effect, Mapping[str, float]]]:
        """The effects, each with its values."""
        return list(zip(self.effects, self.values, strict=True))

    @cached_property
    def acting(self) -> list[tuple[Effect, Mapping[str, float]]]:
        """The effects on inputs with their values, in the order in which they act."""
        return [self.pairs[i] for i in acting_order([effect.family for effect in self.effects])]

    @cached_property
    def rates(self) -> list[tuple[Any, Mapping[str, float]]]:
        """The effects that add rates (half before, half after a step), with their values."""
        return [(e, v) for e, v in self._added if not e.family.parts]

    @cached_property
    def limits(self) -> list[tuple[Any, Mapping[str, float]]]:
        """The effects that limit rates (applied in parts of a step), with their values."""
        return [(e, v) for e, v in self._added if e.family.parts]

    @cached_property
    def losses(self) -> list[tuple[Any, Mapping[str, float]]]:
        """The losses of joints, with their values."""
        return [(e, v) for e, v in self.pairs if isinstance(e.family, LossFamily)]

    @cached_property
    def _added(self) -> list[tuple[Any, Mapping[str, float]]]:
        return [(e, v) for e, v in self.pairs if isinstance(e.family, RateFamily)]

    @cached_property
    def theta(self) -> Array:
        """Free values of all effects in order, (k_effects,)."""
        return np.array([v[q.name] for e, v in self.pairs for q in e.free], float)

    @cached_property
    def sizes(self) -> list[list[int]]:
        """The free values that give each effect its size, as indices into `theta`.

        These are its coefficients; of an effect without any, its times or thresholds.
        """
        found, at = list[list[int]](), 0
        for effect in self.effects:
            every = range(at, at + len(effect.free))
            coefficients = [k for k, q in zip(every, effect.free, strict=True) if not q.grid]
            found.append(coefficients or list(every))
            at += len(effect.free)
        return found

    def with_theta(self, theta: Array) -> Hypothesis:
        """Return the same effects with other free values, clipped to their bounds."""
        values, at = [], 0
        for effect in self.effects:
            some: dict[str, float] = dict(effect.fixed)
            for q in effect.free:
                some[q.name] = float(np.clip(theta[at], q.low, q.high))
                at += 1
            values.append(some)
        return replace(self, values=tuple(values))

    def plus(self, effect: Effect, values: Mapping[str, float]) -> Hypothesis:
        """Add an effect; constants among its values replace the effect's own."""
        whole = {**effect.fixed, **values}
        effect = effect.with_constants(whole)
        return replace(self, effects=(*self.effects, effect), values=(*self.values, whole))

    def minus(self, name: str) -> Hypothesis:
        """Remove an effect."""
        kept = [(effect, values) for effect, values in self.pairs if effect.name != name]
        effects, values = tuple(e for e, _ in kept), tuple(v for _, v in kept)
        return replace(self, effects=effects, values=values)


def by_row(hypotheses: Sequence[Hypothesis], which: Any) -> Hypothesis:
    """Combine hypotheses with the same effects into one that steps many rows (M, n) at once.

    Row i has the values and the shifts of hypothesis `which[i]`, (M,) of int: values are arrays
    (M,), shifts (M, k). What all hypotheses share stays a number, and a shift (k,).
    """
    first = hypotheses[0]
    if len(hypotheses) == 1:
        return first

    def rows(each: Array) -> Any:
        return each[0] if (each == each[0]).all() else each[which]

    values = [
        {q: rows(np.array([h.values[i][q] for h in hypotheses])) for q in own}
        for i, own in enumerate(first.values)
    ]
    shifts = [h.shift for h in hypotheses if h.shift is not None]
    return replace(first, values=tuple(values), shift=rows(np.stack(shifts)) if shifts else None)


def adds_to_steps(h: Hypothesis) -> bool:
    """Check whether a hypothesis changes the model's steps other than by the inputs received."""
    medium = any(isinstance(e.family, MediumFamily) for e in h.effects)
    return bool(h.rates or h.limits or h.losses or medium)


def of_sensor(effect: Effect) -> bool:
    """Check whether an effect changes what is measured, and no step."""
    return isinstance(effect.family, SensorFamily | SensorDelayFamily | SensorLagFamily)
