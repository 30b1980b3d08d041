"""The body of a MuJoCo model for pictures: its visible geoms, moved by MuJoCo's kinematics.

A body without geoms is drawn as the box of its inertia, with a rod from its joint.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from grounded.adapters.tangent import Coordinates
from grounded.figures.body import Part, Pose
from grounded.frozen import Array

SHOWN = 3  # geom groups from here on are hidden, as in MuJoCo's viewer
SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH = 2, 3, 4, 5, 6, 7  # mjtGeom
THIN = 0.012  # radius of a rod, as a fraction of the model's extent
SMALLEST_EDGE = 1e-6  # [m] smallest half edge of a box


class MujocoBody:
    """The body of a compiled model in a Model's coordinates."""

    unit, watched = "m", "the last body's centre of mass"

    def __init__(
        self,
        compiled: Any,
        data: Any,
        coordinates: Coordinates,
        kinematics: Any,
        whole: Callable[[Array], Array],  # from a Model's states to all of the file's
    ) -> None:
        self._model, self._data, self._coordinates = compiled, data, coordinates
        self._whole = whole
        self._kinematics = kinematics  # mj_kinematics
        shown = [g for g in range(compiled.ngeom) if _shown(compiled, g)]
        self._geoms = [g for g in shown if compiled.geom_type[g] in _SHAPES]
        with_shape = {int(compiled.geom_bodyid[g]) for g in self._geoms}
        moving = [b for b in range(1, compiled.nbody) if compiled.body_mass[b] > 0]
        self._bare = [b for b in moving if b not in with_shape]
        small = [b for b in with_shape if _only_spheres(compiled, b)]
        self._rods = [b for b in (*self._bare, *small) if np.linalg.norm(compiled.body_ipos[b]) > 0]
        self.parts = [
            *(_geom(compiled, g) for g in self._geoms),
            *(_inertia(compiled, b) for b in self._bare),
            *(_rod(compiled, b) for b in self._rods),
        ]
        self._watched = moving[-1] if moving else 0

    def poses(self, states: Array) -> list[Pose]:
        """Return the poses of each part, for states (T, n)."""
        compiled, data = self._model, self._data
        frames = []
        for qpos in self._positions(states):
            data.qpos[:] = qpos
            self._kinematics(compiled, data)
            frames.append(
                [
                    *((data.geom_xpos[g], data.geom_xmat[g]) for g in self._geoms),
                    *((data.xipos[b], data.ximat[b]) for b in self._bare),
                    *((data.xpos[b], self._along(b)) for b in self._rods),
                ]
            )
            frames[-1] = [(np.array(x), np.array(m).reshape(3, 3)) for x, m in frames[-1]]
        found = []
        for k, part in enumerate(self.parts):
            turned = np.array([f[k][1] for f in frames]).reshape(-1, 3, 3)
            origin = np.array([f[k][0] for f in frames]).reshape(-1, 3)
            if part.shape == "capsule" and k < len(self._geoms):  # MuJoCo's origin is the centre
                origin = origin - 0.5 * part.size[1] * turned[:, :, 2]
            found.append((origin, turned))
        return found

    def path(self, states: Array) -> Array:
        """Return positions (T, 3) of the last body's centre of mass; NaN if a joint is unknown."""
        found = np.full((len(states), 3), np.nan)
        positions = self._whole(np.asarray(states, float))[:, : self._model.nv]
        for t in np.flatnonzero(np.isfinite(positions).all(axis=1)):
            self._data.qpos[:] = self._positions(states[t : t + 1])[0]
            self._kinematics(self._model, self._data)
            found[t] = self._data.xipos[self._watched]
        return found

    def _positions(self, states: Array) -> Array:
        positions = self._whole(np.asarray(states, float))[:, : self._model.nv]
        return self._coordinates.to_qpos(positions)

    def _along(self, body: int) -> Array:
        """Return axes (3, 3) whose z points from a body's frame to its centre of mass."""
        along = self._data.xipos[body] - self._data.xpos[body]
        return _axes(along / np.linalg.norm(along))


_SHAPES = {
    SPHERE: "ellipsoid",
    CAPSULE: "capsule",
    ELLIPSOID: "ellipsoid",
    CYLINDER: "cylinder",
    BOX: "box",
    MESH: "mesh",
}


def _shown(compiled: Any, geom: int) -> bool:
    return bool(compiled.geom_group[geom] < SHOWN and compiled.geom_rgba[geom][3] > 0)


def _only_spheres(compiled: Any, body: int) -> bool:
    geoms = [g for g in range(compiled.ngeom) if compiled.geom_bodyid[g] == body]
    return all(compiled.geom_type[g] == SPHERE for g in geoms)


def _geom(compiled: Any, geom: int) -> Part:
    kind, size = int(compiled.geom_type[geom]), [float(v) for v in compiled.geom_size[geom]]
    name, shape = f"geom{geom}", _SHAPES[kind]
    if kind == MESH:
        mesh = int(compiled.geom_dataid[geom])
        vertex, face = int(compiled.mesh_vertadr[mesh]), int(compiled.mesh_faceadr[mesh])
        points = compiled.mesh_vert[vertex : vertex + int(compiled.mesh_vertnum[mesh])]
        faces = compiled.mesh_face[face : face + int(compiled.mesh_facenum[mesh])]
        return Part(name, shape, points=np.array(points, float), faces=np.array(faces, float))
    if kind == SPHERE:
        return Part(name, shape, (size[0],) * 3)
    if kind in (CAPSULE, CYLINDER):
        return Part(name, shape, (size[0], 2 * size[1]))
    return Part(name, shape, (size[0], size[1], size[2]))


def _inertia(compiled: Any, body: int) -> Part:
    """Return the box with the body's mass and inertia."""
    a, b, c = (float(v) for v in compiled.body_inertia[body])
    mass = float(compiled.body_mass[body])
    edges = [np.sqrt(max(1.5 * v / mass, 0.0)) for v in (b + c - a, a + c - b, a + b - c)]
    return Part(f"body{body}", "box", tuple(max(float(e), SMALLEST_EDGE) for e in edges))


def _rod(compiled: Any, body: int) -> Part:
    length = float(np.linalg.norm(compiled.body_ipos[body]))
    return Part(f"rod{body}", "capsule", (THIN * float(compiled.stat.extent), length))


def _axes(along: Array) -> Array:
    """Return a rotation matrix (3, 3) whose third column is the unit vector `along`."""
    aside = np.eye(3)[int(np.argmin(np.abs(along)))]
    first = np.cross(aside, along)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(along, first), along], axis=1)
