"""Bodies as plain values: the parts of a robot, and where they are in each of its states."""

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
    box       half an edge each
    ellipsoid half an axis each
    capsule   radius, length from the origin along z
    cylinder  radius, length, the origin in its middle
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
    """What moves: its parts, their poses, the path of the point that is watched."""

    @property
    def parts(self) -> Sequence[Part]:
        """What it is made of."""

    def poses(self, states: Array) -> list[Pose]:
        """Of each part, for states (T, n)."""

    def path(self, states: Array) -> Array:
        """Positions (T, 3) of the point that is watched; NaN where a state is unknown."""
