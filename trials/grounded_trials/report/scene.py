"""Scene: the position and orientation of a body in space, from the model's roles, for pictures.

    position (a, b)      a plane seen from above; states named north and east are drawn as on a map
    altitude             the third axis, up
    attitude             roll, pitch, yaw of an aircraft (z down, Euler angles as in aviation)
    heading              the angle from the first axis towards the second

Without a position, the plane is the phase plane of the first two states; with a position along one
axis, of that and its speed. Coordinates are right-handed with z up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grounded.frozen import Array
from grounded.model import Model
from grounded.task import Task
from grounded_trials.workspace.off_target import asked_for, position_axes, roles_of, tracked

NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # to east, north, up


@dataclass(frozen=True)
class Scene:
    """The states on the axes of a picture, by index; None or () if a model has no such role."""

    names: tuple[str, ...]  # of the axes, horizontal first
    units: tuple[str, ...]
    axes: tuple[int, ...]  # 2 or 3 states
    heading: int | None
    attitude: tuple[int, ...]
    map: bool  # axes are north and east: the heading is measured from north
    spatial: bool  # False: a phase plane

    @property
    def volume(self) -> bool:
        """Whether there is a third axis."""
        return len(self.axes) == 3

    def points(self, states: Array) -> Array:
        """Return positions (T, 3) of states (T, n); the third is 0 if there is no third axis."""
        found = np.zeros((len(states), 3))
        found[:, : len(self.axes)] = states[:, list(self.axes)]
        return found

    def finite(self, states: Array) -> Array:
        """Return the finite positions (k, 3) of states."""
        points = self.points(states)
        return points[np.isfinite(points).all(axis=1)]

    def rotations(self, states: Array) -> Array:
        """Return body axes (nose, left, up) as the columns of rotation matrices (T, 3, 3)."""
        from scipy.spatial.transform import Rotation

        if self.attitude:  # axes nose, right, down in the frame north, east, down
            turned = Rotation.from_euler("ZYX", states[:, list(self.attitude[::-1])]).as_matrix()
            return np.asarray(NED @ turned * [1.0, -1.0, -1.0])
        psi = np.zeros(len(states)) if self.heading is None else states[:, self.heading]
        angle = np.pi / 2 - psi if self.map and self.heading is not None else psi
        return np.asarray(Rotation.from_euler("z", angle[:, None]).as_matrix())


def reading_order(task: Task) -> list[int]:
    """Return the states in the order of charts: position, other weighted states, the rest."""
    every = [*position_axes(task.model), *asked_for(task), *tracked(task), *range(task.model.n)]
    return list(dict.fromkeys(every))


def scene_of(model: Model) -> Scene:
    """Return the scene given by a model's roles."""
    roles, axes = roles_of(model), position_axes(model)
    spatial, position = bool(axes), roles.get("position", [])
    first = [*position, *(roles.get("speed", []) if position else []), *range(model.n)]
    axes = axes or list(dict.fromkeys(first))[:2]
    is_map = spatial and [model.state_names[i] for i in axes[:2]] == ["north", "east"]
    if is_map:
        axes[:2] = axes[1::-1]
    heading, attitude = roles.get("heading", []), roles.get("attitude", [])
    names = [model.state_names[i] for i in axes]
    return Scene(
        names=tuple(names),
        units=tuple(model.states[name] for name in names),
        axes=tuple(axes),
        heading=heading[0] if spatial and heading else None,
        attitude=tuple(attitude) if len(attitude) == 3 and len(axes) == 3 else (),
        map=is_map,
        spatial=spatial,
    )
