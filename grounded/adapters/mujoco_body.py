"""The body of a MuJoCo model for recordings: its joints, moved by MuJoCo's kinematics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from grounded.adapters.tangent import Coordinates
from grounded.frozen import Array


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
        self._parents = np.array(compiled.body_parentid)
        massive = [b for b in range(1, compiled.nbody) if compiled.body_mass[b] > 0]
        self._watched = massive[-1] if massive else 0

    def sticks(self, states: Array) -> Array:
        """Return lines from each body's frame to its parent's, and to its centre of mass.

        Args:
            states: (T, n).

        Returns:
            Ends of the lines (T, S, 2, 3); NaN where a joint is unknown.
        """
        origins, centres = self._places(states)
        inner = np.flatnonzero(self._parents > 0)  # what hangs on the world has no line to it
        bones = np.stack([origins[:, self._parents[inner]], origins[:, inner]], axis=2)
        return np.hstack([bones, np.stack([origins, centres], axis=2)[:, 1:]])

    def path(self, states: Array) -> Array:
        """Return positions (T, 3) of the last body's centre of mass; NaN if a joint is unknown."""
        return self._places(states)[1][:, self._watched]

    def _places(self, states: Array) -> tuple[Array, Array]:
        """Return the origins and the centres of mass of all bodies, (T, bodies, 3) each."""
        origins = np.full((len(states), self._model.nbody, 3), np.nan)
        centres = origins.copy()
        positions = self._whole(np.asarray(states, float))[:, : self._model.nv]
        for t in np.flatnonzero(np.isfinite(positions).all(axis=1)):
            self._data.qpos[:] = self._coordinates.to_qpos(positions[t : t + 1])[0]
            self._kinematics(self._model, self._data)
            origins[t], centres[t] = self._data.xpos, self._data.xipos
        return origins, centres
