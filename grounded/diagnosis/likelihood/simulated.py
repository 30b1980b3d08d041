"""Caches for a simulator as the crude model, whose step takes microseconds instead of nanoseconds.

A diagnosis evaluates thousands of steps along nearly the same tracks, so results are reused:

`Slopes`    of steps from the same samples. Along the track of a hypothesis during its fit, slopes
            are taken anew only where it moved by more than SLOPES_HOLD of the range of the log;
            the track that the filter is linearised about is no more accurate than that
`tangent`   steps from samples nearby, with a value or an input changed slightly, by these slopes
`carried`   rollouts with losses of joints

Each fit follows its own track (`Slopes.following`), from the slopes at the first of the hypotheses
fitted together (`refine`). So its result does not depend on which others are fitted, or where.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from hashlib import blake2b

import numpy as np

from grounded.compile.run.differenced import DifferencedSystem
from grounded.frozen import Array
from grounded.model import Model

SLOPES_HOLD = 0.01  # fraction of a state's spread, an input's peak or a parameter's size
SLOPES_KEPT = 24  # sets of slopes in the cache

Take = Callable[[Array, Array], tuple[Array, ...]]  # x (N, n), u (N, m) -> slopes (N, ...)


def simulated(model: Model) -> bool:
    """Check whether a model is a black box, without compiled steps and derivatives."""
    return isinstance(model.system, DifferencedSystem)


@dataclass(frozen=True, eq=False)
class _Taken:
    """Slopes, and the point at which each row of them was taken."""

    x: Array
    u: Array
    p: Array
    found: tuple[Array, ...]


@dataclass(eq=False)
class Slopes:
    """A cache of a simulator's slopes."""

    unit: tuple[Array, Array, Array]  # of states, inputs, parameters
    same: dict[bytes, tuple[Array, ...]] = field(default_factory=dict)
    near: dict[bool, _Taken] | None = None  # key: whether slopes by parameters are included

    def following(self) -> Slopes:
        """Return a cache that follows one track, starting from these slopes."""
        return Slopes(self.unit, self.same, dict(self.near or {}))

    def at(self, take: Take, x: Array, u: Array, p: Array, full: bool) -> tuple[Array, ...]:
        """Return slopes at x (N, n), u (N, m), p (k,); `full`: with those by the parameters."""
        near = self.near or {}
        old = near.get(full) or near.get(True)
        if old is None or old.x.shape != x.shape or self._far(2, p, old.p).any():
            found = self._same(take, x, u, p, full)
        else:
            far = np.hstack([self._far(0, x, old.x), self._far(1, u, old.u)])
            moved = np.asarray(far.any(axis=1))
            found = old.found if full else old.found[:2]
            if moved.any():
                found = tuple(f.copy() for f in found)
                again = self._same(take, x[moved], u[moved], p, full)
                for kept, fresh in zip(found, again, strict=True):
                    kept[moved] = fresh
            x, u = (np.where(moved[:, None], a, b) for a, b in ((x, old.x), (u, old.u)))
            p = old.p
        if self.near is not None and len(found) == 2 + full:
            self.near[full] = _Taken(x, u, p, found)
        return found

    def about(self, x: Array) -> tuple[Array, ...] | None:
        """Return the cached slopes of as many rows as x (N, n), wherever taken, or None."""
        old = (self.near or {}).get(True) or (self.near or {}).get(False)
        return old.found if old is not None and old.x.shape == x.shape else None

    def _far(self, kind: int, one: Array, other: Array) -> Array:
        return np.asarray(np.abs(one - other) > SLOPES_HOLD * self.unit[kind])

    def _same(self, take: Take, x: Array, u: Array, p: Array, full: bool) -> tuple[Array, ...]:
        key = blake2b(b"".join(a.tobytes() for a in (x, u, p, np.array(full)))).digest()
        if (found := self.same.get(key)) is None:
            found = take(x, u)
        self.same.pop(key, None)
        self.same[key] = found  # least recently used first
        for old in list(self.same)[:-SLOPES_KEPT]:
            self.same.pop(old, None)
        return found
