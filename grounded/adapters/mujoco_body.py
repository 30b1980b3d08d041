"""The body of a MuJoCo model for recordings: its visible geoms, moved by MuJoCo's kinematics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from grounded.adapters.tangent import Coordinates
from grounded.figures.body import Part, Pose
from grounded.frozen import Array

SHOWN = 3  # geom groups from here on are hidden, as in MuJoCo's viewer
SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH = 2, 3, 4, 5, 6, 7  # mjtGeom


class MujocoBody:
    """The body of a compiled model in a Model's coordinates."""

    unit = "m"

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
        self.parts = [_geom(compiled, g) for g in self._geoms]
        moving = [b for b in range(1, compiled.nbody) if compiled.body_mass[b] > 0]
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
                    (data.geom_xpos[g].copy(), data.geom_xmat[g].reshape(3, 3).copy())
                    for g in self._geoms
                ]
            )
        found = []
        for k, part in enumerate(self.parts):
            turned = np.array([f[k][1] for f in frames]).reshape(-1, 3, 3)
            origin = np.array([f[k][0] for f in frames]).reshape(-1, 3)
            if part.shape == "capsule":  # MuJoCo's origin is the centre
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
