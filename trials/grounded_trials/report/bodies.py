"""Bodies: a robot as a stick figure in each state, from the roles of its model, and its scene.

    position                    a kite that points ahead, along its path
    hanging, upright, level     a chain of links in a vertical plane: the angles of their joints,
                                where the first is zero downwards, upwards, or along x
    rail                        the position of a carriage that carries the links
    a MuJoCo model              the joints of its file
    none of these               a dot in the plane of the first two states

A `Scene` is the position and orientation of a body in space:

    position (a, b)      a plane seen from above; states named north and east are drawn as on a map
    altitude             the third axis, up
    attitude             roll, pitch, yaw of an aircraft (z down, Euler angles as in aviation)
    heading              the angle from the first axis towards the second

Without a position, the plane is the phase plane of the first two states; with a position along one
axis, of that and its speed. Coordinates are right-handed with z up.

The lengths of links are the parameters l1, l2 ..., or l, L or length, in m. A single link takes the
only parameter in m, whatever its name. If the lengths are unknown, links have equal length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from grounded.figures import Body
from grounded.frozen import Array
from grounded.model import Model
from grounded.task import Task
from grounded_trials.report.findings import Findings
from grounded_trials.workspace.off_target import asked_for, position_axes, roles_of, tracked

# nose, right, tail, left, and the top of a fin; (nose, left, up) axes, for a length of 1
CORNERS = np.array([(0.6, 0, 0), (-0.4, -0.4, 0), (-0.2, 0, 0), (-0.4, 0.4, 0), (-0.4, 0, 0.3)])
KITE = CORNERS[[(0, 1), (1, 2), (2, 3), (3, 0), (2, 4)]]  # its edges (5, 2, 3)
ZEROS = {"hanging": (-np.pi / 2, 1), "upright": (np.pi / 2, -1), "level": (0.0, 1)}
LENGTH = 0.07  # size of a vehicle, as a fraction of the paths' size
NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # to east, north, up


@dataclass(frozen=True)
class Scene:
    """The states on the axes of a picture, by index; None or () if a model has no such role.

    It is also the body of a vehicle: a mark along the path, a kite in space, in a phase plane a
    dot.
    """

    names: tuple[str, ...]  # of the axes, horizontal first
    units: tuple[str, ...]
    axes: tuple[int, ...]  # 2 or 3 states
    heading: int | None
    attitude: tuple[int, ...]
    map: bool  # axes are north and east: the heading is measured from north
    spatial: bool  # False: a phase plane
    size: float = 1.0  # of a kite

    @property
    def unit(self) -> str:
        """The unit of the first axis."""
        return self.units[0]

    @property
    def volume(self) -> bool:
        """Whether there is a third axis."""
        return len(self.axes) == 3

    def path(self, states: Array) -> Array:
        """Return positions (T, 3) of states (T, n); the third is 0 if there is no third axis."""
        found = np.zeros((len(states), 3))
        found[:, : len(self.axes)] = states[:, list(self.axes)]
        return found

    def sticks(self, states: Array) -> Array:
        """Return the kite's edges (T, 5, 2, 3), turned by heading or attitude; none of a dot."""
        kite = self.size * (KITE if self.spatial else KITE[:0])
        turned = np.einsum("tij,skj->tski", self.rotations(states), kite)
        return np.asarray(self.path(states)[:, None, None] + turned)

    def rotations(self, states: Array) -> Array:
        """Return body axes (nose, left, up) as the columns of rotation matrices (T, 3, 3)."""
        from scipy.spatial.transform import Rotation  # takes 0.1 s, for recordings alone

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


def body_in(findings: Findings) -> Body:
    """Return the body of a workspace's model, in a size that is visible next to the path."""
    model = findings.task.model
    scene, drawn = scene_of(model), findings.runs or findings.logs
    points = finite(scene.path(drawn[0].trial.states if drawn else findings.task.target))
    size = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    return body_of(model, scene, LENGTH * (size or 1.0))


def body_of(model: Model, scene: Scene, size: float) -> Body:
    """Return the body of a model."""
    own: Body | None = getattr(model.step, "body", None)  # provided by an adapter
    if own is not None:
        return own
    roles = roles_of(model)
    for role, (zero, sign) in ZEROS.items():
        if angles := roles.get(role, []):
            lengths = _lengths(model, len(angles))
            unit = "m" if all(lengths) else ""
            drawn = tuple(length or 1.0 for length in lengths)
            return Links(tuple(angles), drawn, zero, sign, unit, tuple(roles.get("rail", [])))
    return replace(scene, size=size)


def is_mechanism(body: Body) -> bool:
    """Return whether a body is drawn from the side; otherwise it is a mark along a path."""
    return not isinstance(body, Scene)


def finite(points: Array) -> Array:
    """Return the finite ones of some points (T, 3)."""
    return points[np.isfinite(points).all(axis=1)]


def _lengths(model: Model, count: int) -> tuple[float, ...]:
    """Return the lengths of the links [m], 0 where unknown."""
    metres = {name.lower(): p.value for name, p in model.params.items() if p.unit == "m"}
    shared = metres.get("l", metres.get("length", 0.0))
    if len(metres) == count == 1:
        shared = next(iter(metres.values()))
    return tuple(metres.get(f"l{i}", shared) for i in range(1, count + 1))


@dataclass(frozen=True, eq=False)
class Links:
    """A chain of links in the plane of x and z, optionally on a carriage along x."""

    angles: tuple[int, ...]  # indices of the states
    lengths: tuple[float, ...]
    zero: float  # [rad] direction of the first link at angle zero, from x towards z
    sign: int
    unit: str
    rail: tuple[int, ...] = ()  # index of the carriage's state, or empty

    def sticks(self, states: Array) -> Array:
        """Return each link from its joint to the next (T, k, 2, 3)."""
        joints = self._joints(states)
        return np.stack([joints[:, :-1], joints[:, 1:]], axis=2)

    def path(self, states: Array) -> Array:
        """Return the positions of the last link's end (T, 3)."""
        return self._joints(states)[:, -1]

    def _joints(self, states: Array) -> Array:
        """Return positions of joints and tip (T, k + 1, 3)."""
        turned = self.zero + self.sign * np.cumsum(states[:, list(self.angles)], axis=1)
        steps = np.stack([np.cos(turned), 0 * turned, np.sin(turned)], axis=2)
        base = np.zeros((len(states), 1, 3))
        if self.rail:
            base[:, 0, 0] = states[:, self.rail[0]]
        return np.cumsum(np.hstack([base, steps * np.array(self.lengths)[:, None]]), axis=1)


def reach(body: Body, states: Array) -> Array:
    """Return points (k, 3) that a body reaches in the finite ones of some states."""
    path = body.path(states)
    known = states[np.isfinite(path).all(axis=1)]
    if not len(known) or not is_mechanism(body):
        return finite(path)
    chosen = np.nan_to_num(known[:: max(1, len(known) // 60)])
    return np.vstack([finite(path), body.sticks(chosen).reshape(-1, 3)])
