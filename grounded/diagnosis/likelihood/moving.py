"""A hypothesis with a medium that moves: the same without it, seen from axes that move along.

    f_h(x) = over(f_still(through(x))),     F_h = D over  F_still  D through

Its model, the rates and the losses beside it all see velocities through the medium.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from grounded.compile import Named
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.effects import Effect, MediumFamily
from grounded.effects.medium import over_ground, through_it
from grounded.frozen import Array

NUDGE = 1e-6  # of a state's unit: what slopes are taken over


@dataclass(frozen=True, eq=False)
class Moving:
    """One medium's change of axes, of states (..., n); `still`: the hypothesis without it."""

    still: Hypothesis
    names: tuple[str, ...]  # of the states, as physics sees them
    effect: Effect
    values: Mapping[str, float]

    def through(self, x: Array) -> Array:
        """States over ground as the medium sees them."""
        return _array(through_it(self.effect, self._named(x), self.values))

    def over(self, x: Array, dt: float) -> Array:
        """States that the medium saw, dt after it began to: over ground."""
        return _array(over_ground(self.effect, self._named(x), self.values, dt))

    def slopes(self, before: Array, after: Array) -> tuple[Array, Array]:
        """D through at x before a step, D over at x after it, both as the medium sees them."""
        return self._slope(self.over(before, 0.0), -1.0), self._slope(after, 1.0)

    def _slope(self, x: Array, sign: float) -> Array:
        """1 + sign d shift / d x, (..., n, n)."""
        n = x.shape[-1]
        found = np.broadcast_to(np.eye(n), (*x.shape, n)).copy()
        base = self.through(x) - x
        for j in range(n):
            other = x.copy()
            other[..., j] += NUDGE
            found[..., j] -= sign * (self.through(other) - other - base) / NUDGE
        return found

    def _named(self, x: Array) -> Named:
        return Named("state", self.names, list(np.moveaxis(x, -1, 0)))


def _array(values: Mapping[str, Array]) -> Array:
    return np.stack(list(values.values()), axis=-1)


def moving(h: Hypothesis, names: tuple[str, ...]) -> Moving | None:
    """The medium that moves under a hypothesis, if one does; `names` as physics sees the states."""
    for effect, values in h.pairs:
        if isinstance(effect.family, MediumFamily):
            return Moving(h.minus(effect.name), names, effect, values)
    return None
