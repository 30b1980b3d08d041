"""Positions of joints as plain coordinates: rotations as rotation vectors about a reference.

A ball or free joint keeps its orientation as a unit quaternion, which has four numbers for three
degrees of freedom. A Model needs plain coordinates, so the orientation becomes the rotation vector
r (axis times angle [rad]) from a reference orientation,

    q = q_ref exp(r),        exp(r) = [cos |r|/2, sin |r|/2 r/|r|],

the tangent that `mj_integratePos` and `mj_differentiatePos` use. Of the vectors r + 2 pi k r/|r|
that mean the same orientation the one nearest to the state before the step is taken, so that a
step is continuous and a full turn counts on.
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
    """Which numbers of qpos (nq) are plain, which are quaternions, and their columns (nv)."""

    plain: Indices  # places in qpos
    plain_columns: Indices  # their coordinates
    quaternions: tuple[int, ...]  # first place in qpos of each quaternion
    rotations: tuple[int, ...]  # first coordinate of each rotation vector
    reference: Array  # (nq,) the pose that rotation vectors are about

    def to_qpos(self, r: Array) -> Array:
        """Coordinates (N, nv) -> positions (N, nq)."""
        qpos = np.tile(self.reference, (len(r), 1))
        qpos[:, self.plain] = r[:, self.plain_columns]
        for place, column in zip(self.quaternions, self.rotations, strict=True):
            about = self._about(place)
            turned = about * type(about).from_rotvec(r[:, column : column + 3])
            qpos[:, place : place + 4] = np.roll(turned.as_quat(), 1, axis=1)  # MuJoCo: w first
        return qpos

    def from_qpos(self, qpos: Array, near: Array) -> Array:
        """Positions (N, nq) -> coordinates (N, nv), rotation vectors nearest to `near` (N, nv)."""
        r = np.zeros((len(qpos), len(self.plain) + 3 * len(self.rotations)))
        r[:, self.plain_columns] = qpos[:, self.plain]
        for place, column in zip(self.quaternions, self.rotations, strict=True):
            about = self._about(place)
            turned = type(about).from_quat(np.roll(qpos[:, place : place + 4], -1, axis=1))
            found = (about.inv() * turned).as_rotvec()
            r[:, column : column + 3] = nearest_turn(found, near[:, column : column + 3])
        return r

    def _about(self, place: int) -> Any:
        """The reference orientation of the quaternion at a place in qpos, a scipy Rotation."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_quat(np.roll(self.reference[place : place + 4], -1))


def nearest_turn(r: Array, near: Array) -> Array:
    """The vector of the same orientation as r (N, 3) that lies nearest to `near` (N, 3)."""
    angle = np.linalg.norm(r, axis=-1, keepdims=True)
    axis = r / np.where(angle > 1e-12, angle, 1.0)
    along = np.sum(axis * near, axis=-1, keepdims=True)
    return np.asarray(r + 2 * np.pi * np.rint((along - angle) / (2 * np.pi)) * axis)
