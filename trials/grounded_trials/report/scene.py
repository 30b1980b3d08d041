"""Scene: where the model's roles put a body in space, for pictures.

    position (a, b)      a plane, seen from above; named north, east: drawn as maps are, east right
    altitude             the third axis, up
    attitude             roll, pitch, yaw of an aircraft (z down, Euler angles as in aviation)
    heading              the angle from the first axis towards the second

Without a position the plane is the phase plane of the first two states: something moves in any
model. Coordinates are right-handed with z up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grounded.frozen import Array
from grounded.model import Model


@dataclass(frozen=True)
class Scene:
    """Which states are the axes of a picture, by index; None where a model has no such role."""

    names: tuple[str, ...]  # of the axes, horizontal first
    units: tuple[str, ...]
    axes: tuple[int, ...]  # 2 or 3 states
    heading: int | None
    attitude: tuple[int, ...]
    map: bool  # north and east: heading counts from north
    spatial: bool  # False: a phase plane

    @property
    def volume(self) -> bool:
        """Whether there is a third axis."""
        return len(self.axes) == 3

    def points(self, states: Array) -> Array:
        """Positions (T, 3) of states (T, n); zero where there is no third axis."""
        found = np.zeros((len(states), 3))
        found[:, : len(self.axes)] = states[:, list(self.axes)]
        return found

    def finite(self, states: Array) -> Array:
        """Positions (k, 3) of those states that have one."""
        points = self.points(states)
        return points[np.isfinite(points).all(axis=1)]

    def rotations(self, states: Array) -> Array:
        """Body axes (nose, left, up) as the columns of rotation matrices (T, 3, 3)."""
        if self.attitude:
            return _aircraft(*(states[:, i] for i in self.attitude))
        if self.heading is None:
            return np.tile(np.eye(3), (len(states), 1, 1))
        psi = states[:, self.heading]
        angle = np.pi / 2 - psi if self.map else psi
        c, s, zero = np.cos(angle), np.sin(angle), np.zeros(len(states))
        rows = [[c, -s, zero], [s, c, zero], [zero, zero, zero + 1]]
        return np.moveaxis(np.array(rows), 2, 0)


def scene_of(model: Model) -> Scene:
    """The scene of a model's roles."""
    index = {name: i for i, name in enumerate(model.state_names)}
    roles = {
        role: [index[n] for n in ((names,) if isinstance(names, str) else names) if n in index]
        for role, names in model.roles.items()
    }
    position = roles.get("position", [])
    spatial = len(position) >= 2
    axes = position[:3] if spatial else list(range(min(2, model.n)))
    is_map = spatial and [model.state_names[i] for i in axes[:2]] == ["north", "east"]
    if is_map:
        axes[:2] = axes[1::-1]
    if spatial and len(axes) == 2:
        axes += roles.get("altitude", [])[:1]
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


def _aircraft(phi: Array, theta: Array, psi: Array) -> Array:
    """Columns nose, left wing, up in (east, north, up), from yaw, pitch, roll about z, y, x."""
    cf, sf, ct, st = np.cos(phi), np.sin(phi), np.cos(theta), np.sin(theta)
    cp, sp = np.cos(psi), np.sin(psi)
    nose = [ct * cp, ct * sp, -st]  # in north, east, down
    right = [sf * st * cp - cf * sp, sf * st * sp + cf * cp, sf * ct]
    down = [cf * st * cp + sf * sp, cf * st * sp - sf * cp, cf * ct]
    columns = [nose, [-v for v in right], [-v for v in down]]
    enu = [[v[1], v[0], -v[2]] for v in columns]
    return np.moveaxis(np.array(enu), 2, 0).swapaxes(1, 2)
