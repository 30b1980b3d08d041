"""Bodies as plain values: the parts of a robot and their poses in each state.

A recording draws the parts in space; `motion` is the side view of a body, for a page.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from grounded.frozen import Array

Pose = tuple[Array, Array]  # origins (T, 3), rotation matrices (T, 3, 3)
NONE: Array = np.zeros((0, 3))
FRAMES = 400  # most poses in a motion, over all parts
SEEN = [0, 2]  # the side view shows x and z


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
    """A moving body: its parts, their poses, and the path of a watched point."""

    @property
    def unit(self) -> str:
        """Unit of positions; "" if its size is unknown."""

    @property
    def watched(self) -> str:
        """Name of the watched point, such as `the tip`."""

    @property
    def parts(self) -> Sequence[Part]:
        """The parts of the body."""

    def poses(self, states: Array) -> list[Pose]:
        """Return the poses of each part, for states (T, n)."""

    def path(self, states: Array) -> Array:
        """Return positions (T, 3) of the watched point; NaN where a state is unknown."""


@dataclass(frozen=True, eq=False)
class Motion:
    """The side view of a moving body: x to the right, z up.

    times: (T,) times of the poses [s].
    wires: for each part its polylines (k, 3) in its own frame, and their thickness.
    poses: (T, parts, 2, 4): rotation and origin of each part, for x and z.
    """

    times: Array
    wires: tuple[tuple[tuple[Array, ...], float], ...]
    poses: Array

    @property
    def reached(self) -> Array:
        """Points (k, 2) that the body passes through, for the range of the axes."""
        every = range(0, len(self.times), -(-len(self.times) // 60))
        return np.vstack([line for row in every for line, _ in self.lines(row)])

    def lines(self, row: int) -> list[tuple[Array, float]]:
        """Return the polylines (k, 2) at one of the times, each with its thickness."""
        return [
            (strip @ pose[:, :3].T + pose[:, 3], thick)
            for (strips, thick), pose in zip(self.wires, self.poses[row], strict=True)
            for strip in strips
        ]


def motion(body: Body, states: Array, dt: float) -> Motion | None:
    """Return the motion of a body along states (T, n); None if its position is never known."""
    rows = np.flatnonzero(np.isfinite(body.path(states)).all(axis=1))
    rows = rows[:: -(-len(rows) * len(body.parts) // FRAMES) or 1]
    if not len(rows) or not body.parts:
        return None
    known = np.where(np.isfinite(states[rows]), states[rows], 0.0)  # rates don't move it
    poses = [np.concatenate([turn, at[..., None]], axis=2) for at, turn in body.poses(known)]
    seen = np.stack(poses, axis=1)[:, :, SEEN]
    return Motion(np.float64(dt) * rows, tuple(wires(part) for part in body.parts), seen)


def wires(part: Part) -> tuple[tuple[Array, ...], float]:
    """Return polylines that show a part from any side, and their thickness (0: thin)."""
    if part.shape == "capsule":
        return (np.array([[0, 0, 0], [0, 0, part.size[1]]], float),), 2 * part.size[0]
    if part.shape in ("lines", "dot"):
        return part.strips or (np.zeros((2, 3)),), 0.0
    if part.shape == "ellipsoid":
        turn = np.linspace(0, 2 * np.pi, 25)
        round_ = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
        return tuple(np.roll(round_, k, axis=1) * part.size for k in range(3)), 0.0
    if part.shape == "cylinder":
        radius, length = part.size
        low, high = np.array([[-radius, -radius, -length / 2], [radius, radius, length / 2]])
    elif part.shape == "mesh":
        low, high = part.points.min(axis=0), part.points.max(axis=0)
    else:
        low, high = -np.array(part.size), np.array(part.size)
    around = [(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)]
    rings = [np.array([[x, y, z] for x, z in around]) for y in (0, 1)]
    return tuple(low + ring * (high - low) for ring in rings), 0.0
