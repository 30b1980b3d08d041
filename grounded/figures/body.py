"""Bodies as plain values: the parts of a robot and their poses in each state, for a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from grounded.frozen import Array

Pose = tuple[Array, Array]  # origins (T, 3), rotation matrices (T, 3, 3)
NONE: Array = np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class Part:
    """A rigid part in its own frame.

    shape     size
    box       half of each edge
    ellipsoid half of each axis
    capsule   radius, length from the origin along z
    cylinder  radius, length, centred at the origin
    mesh      none: `points` and `faces`
    lines     none: `strips`
    dot       none
    """

    name: str
    shape: str
    size: tuple[float, ...] = ()
    points: Array = field(default_factory=lambda: NONE)
    faces: Array = field(default_factory=lambda: NONE)
    strips: tuple[Array, ...] = ()


class Body(Protocol):
    """A moving body: its parts, their poses, and the path of its end."""

    @property
    def unit(self) -> str:
        """Unit of positions; "" if its size is unknown."""

    @property
    def parts(self) -> Sequence[Part]:
        """The parts of the body."""

    def poses(self, states: Array) -> list[Pose]:
        """Return the poses of each part, for states (T, n)."""

    def path(self, states: Array) -> Array:
        """Return positions (T, 3) of the body, or its end; NaN where a state is unknown."""
