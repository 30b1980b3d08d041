"""A simulator as the crude model: its step takes microseconds, a compiled one nanoseconds.

A diagnosis asks for thousands of steps along much the same tracks, so what was found is used again:

`Slopes`    of a step, at the same samples; and along the track of one hypothesis that climbs, they
            are taken anew where it moved by more than NEAR of what the log spans. A filter is
            linearised about a track that is no nearer to the truth than that
`tangent`   steps from samples close by, with a value nudged or an input changed, by these slopes
`carried`   one step after the other, with what joints lose

Each hypothesis that climbs follows its own track (`Slopes.following`), from the slopes at the first
of those that climb together (`refine`), so that it does not matter what else is fitted, or where.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from hashlib import blake2b

import numpy as np

from grounded.compile.run.differenced import DifferencedSystem
from grounded.frozen import Array
from grounded.model import Model

NEAR = 0.01  # of the spread of a state, the peak of an input, the size of a parameter
KEPT = 24  # sets of slopes

Take = Callable[[Array, Array], tuple[Array, ...]]  # x (N, n), u (N, m) -> slopes (N, ...)


def simulated(model: Model) -> bool:
    """Whether a model is a black box whose steps are called one after the other."""
    return isinstance(model.system, DifferencedSystem)


@dataclass(frozen=True, eq=False)
class _Taken:
    """Slopes, and where each row of them was taken."""

    x: Array
    u: Array
    p: Array
    found: tuple[Array, ...]


@dataclass(eq=False)
class Slopes:
    """The slopes of a simulator that were taken."""

    unit: tuple[Array, Array, Array]  # of states, inputs, parameters
    same: dict[bytes, tuple[Array, ...]] = field(default_factory=dict)
    near: dict[bool, _Taken] | None = None  # with those of the parameters, or without

    def following(self) -> Slopes:
        """Those of one track, however it moves, from where these stand."""
        return Slopes(self.unit, self.same, dict(self.near or {}))

    def at(self, take: Take, x: Array, u: Array, p: Array, full: bool) -> tuple[Array, ...]:
        """The slopes at x (N, n), u (N, m), parameters p (k,); `full` where they are among them."""
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
        """Those that stand for as many rows as x (N, n), wherever they were taken."""
        old = (self.near or {}).get(True) or (self.near or {}).get(False)
        return old.found if old is not None and old.x.shape == x.shape else None

    def _far(self, kind: int, one: Array, other: Array) -> Array:
        return np.asarray(np.abs(one - other) > NEAR * self.unit[kind])

    def _same(self, take: Take, x: Array, u: Array, p: Array, full: bool) -> tuple[Array, ...]:
        key = blake2b(b"".join(a.tobytes() for a in (x, u, p, np.array(full)))).digest()
        if (found := self.same.get(key)) is None:
            found = take(x, u)
        self.same.pop(key, None)
        self.same[key] = found  # the last that was asked for goes last
        for old in list(self.same)[:-KEPT]:
            self.same.pop(old, None)
        return found
