"""Joint positions as plain coordinates: rotations as rotation vectors about a reference.

A ball or free joint stores its orientation as a unit quaternion, with four numbers for three
degrees of freedom. A Model needs plain coordinates, so the orientation is expressed by the rotation
vector r (axis times angle [rad]) from a reference orientation,

    q = q_ref exp(r),        exp(r) = [cos |r|/2, sin |r|/2 r/|r|],

as in `mj_integratePos` and `mj_differentiatePos`. All vectors r + 2 pi k r/|r| describe the same
orientation; the one nearest to the state before the step is used, so that a step is continuous and
full turns are counted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grounded.frozen import Array

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Mapping between qpos (nq), with quaternions, and plain coordinates (nv)."""

    plain: Indices  # indices in qpos that are not part of a quaternion
    plain_columns: Indices  # their coordinates
    quaternions: tuple[int, ...]  # first index in qpos of each quaternion
    rotations: tuple[int, ...]  # first coordinate of each rotation vector
    reference: Array  # (nq,) the pose that rotation vectors refer to

    def to_qpos(self, r: Array) -> Array:
        """Convert coordinates (N, nv) to positions (N, nq)."""
        qpos = np.tile(self.reference, (len(r), 1))
        qpos[:, self.plain] = r[:, self.plain_columns]
        for place, column in zip(self.quaternions, self.rotations, strict=True):
            about = self._about(place)
            turned = about * type(about).from_rotvec(r[:, column : column + 3])
            qpos[:, place : place + 4] = np.roll(turned.as_quat(), 1, axis=1)  # MuJoCo: w first
        return qpos

    def from_qpos(self, qpos: Array, near: Array) -> Array:
        """Convert positions (N, nq) to coordinates (N, nv) nearest to `near` (N, nv)."""
        r = np.zeros((len(qpos), len(self.plain) + 3 * len(self.rotations)))
        r[:, self.plain_columns] = qpos[:, self.plain]
        for place, column in zip(self.quaternions, self.rotations, strict=True):
            about = self._about(place)
            turned = type(about).from_quat(np.roll(qpos[:, place : place + 4], -1, axis=1))
            found = (about.inv() * turned).as_rotvec()
            r[:, column : column + 3] = nearest_turn(found, near[:, column : column + 3])
        return r

    def _about(self, place: int) -> Any:
        """Return the reference orientation of the quaternion at an index in qpos, as a Rotation."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_quat(np.roll(self.reference[place : place + 4], -1))


def nearest_turn(r: Array, near: Array) -> Array:
    """Return the vector of the same orientation as r (N, 3) that is nearest to `near` (N, 3)."""
    angle = np.linalg.norm(r, axis=-1, keepdims=True)
    axis = r / np.where(angle > 1e-12, angle, 1.0)
    along = np.sum(axis * near, axis=-1, keepdims=True)
    return np.asarray(r + 2 * np.pi * np.rint((along - angle) / (2 * np.pi)) * axis)
