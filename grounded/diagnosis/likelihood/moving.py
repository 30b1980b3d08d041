"""Hypotheses with a moving medium (a current, wind), as a change of axes.

Velocities through the medium go into the step of the hypothesis without it, and the result is
converted back to velocities over ground:

    f_h(x) = over(f_still(through(x))),     F_h = D over  F_still  D through

So the model, the added rates and the losses all see velocities through the medium.
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

NUDGE = 1e-6  # finite-difference step in a state's unit


@dataclass(frozen=True, eq=False)
class Moving:
    """The change of axes of one medium, for states (..., n)."""

    still: Hypothesis  # without the medium
    names: tuple[str, ...]  # state names as effects see them (`seen_names`)
    effect: Effect
    values: Mapping[str, float]

    def through(self, x: Array) -> Array:
        """Convert states over ground to states through the medium."""
        return _array(through_it(self.effect, self._named(x), self.values))

    def over(self, x: Array, dt: float) -> Array:
        """Convert states through the medium to states over ground, after a step of dt."""
        return _array(over_ground(self.effect, self._named(x), self.values, dt))

    def slopes(self, before: Array, after: Array) -> tuple[Array, Array]:
        """Return D through before a step and D over after it, both at states through the medium."""
        return self._slope(self.over(before, 0.0), -1.0), self._slope(after, 1.0)

    def _slope(self, x: Array, sign: float) -> Array:
        """Return 1 + sign d shift / d x, (..., n, n)."""
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
    """Return the moving medium of a hypothesis, or None; `names` as effects see the states."""
    for effect, values in h.pairs:
        if isinstance(effect.family, MediumFamily):
            return Moving(h.minus(effect.name), names, effect, values)
    return None
