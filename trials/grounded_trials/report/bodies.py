"""Bodies: the shape and pose of a robot in each state, from the roles of its model, and its scene.

    position                    a car from above, or an aircraft, along its path
    hanging, upright, level     a chain of links in a vertical plane: the angles of their joints,
                                where the first is zero downwards, upwards, or along x
    rail                        the position of a carriage that carries the links; with a speed,
                                of the wheels of a vehicle that balances
    altitude, without position  a cabin that moves up and down
    a MuJoCo model              the geometry of its file
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

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.figures.body import Body, Part, Pose
from grounded.frozen import Array
from grounded.model import Model
from grounded.task import Task
from grounded_trials.report.findings import Findings
from grounded_trials.workspace.off_target import asked_for, position_axes, roles_of, tracked

CAR = (
    [(-0.5, -0.25, 0), (0.5, -0.25, 0), (0.5, 0.25, 0), (-0.5, 0.25, 0), (-0.5, -0.25, 0)],
    [(0.5, -0.25, 0), (0.85, 0, 0), (0.5, 0.25, 0)],
)
AIRCRAFT = (
    [(-0.6, 0, 0), (0.5, 0, 0)],
    [(-0.1, 0.8, 0), (0.2, 0, 0), (-0.1, -0.8, 0), (-0.1, 0.8, 0)],
    [(-0.6, 0.25, 0), (-0.6, -0.25, 0)],
    [(-0.4, 0, 0), (-0.65, 0, 0.25), (-0.6, 0, 0)],
)
ZEROS = {"hanging": (-np.pi / 2, 1), "upright": (np.pi / 2, -1), "level": (0.0, 1)}
LENGTH = 0.07  # size of a body of unknown length, as a fraction of the paths' size
SLIM = 0.06  # radius of a link, as a fraction of the longest link
ROPE = 0.005  # radius of a crane's rope, as a fraction of the longest one
LOAD = 0.05  # half edge of a crane's load, as a fraction of the longest rope
CARRIAGE = (0.25, 0.12, 0.1)  # half edges of the carriage, as fractions of the links' length
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


def body_in(findings: Findings) -> Body:
    """Return the body of a workspace's model, in a size that is visible next to the path."""
    model = findings.task.model
    scene, shown = scene_of(model), findings.runs or findings.logs
    points = scene.finite(shown[0].trial.states if shown else findings.task.target)
    size = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    return body_of(model, scene, LENGTH * (size or 1.0))


def body_of(model: Model, scene: Scene, size: float) -> Body:
    """Return the body of a model.

    Args:
        model: provides roles and parameters.
        scene: the position and orientation of the body.
        size: length of a body of unknown length.
    """
    own: Body | None = getattr(model.step, "body", None)  # provided by an adapter
    if own is not None:
        return own
    for role, (zero, sign) in ZEROS.items():
        if angles := _columns(model, role):
            lengths = _lengths(model, len(angles))
            unit = "m" if all(lengths) else ""
            drawn = tuple(length or 1.0 for length in lengths)
            rail = _columns(model, "rail")
            wide = min(CARRIAGE[0] * sum(drawn), size) if unit else CARRIAGE[0] * sum(drawn)
            drives = bool(rail) and bool(_columns(model, "speed"))
            return Links(angles, drawn, zero, sign, unit, rail, wide, drives)
    if not scene.spatial and (height := _columns(model, "altitude")):
        return Cabin(height[0], size, list(model.states.values())[height[0]])
    return Vehicle(scene, size)


def is_mechanism(body: Body) -> bool:
    """Return whether a body is drawn from the side; otherwise it is a mark along a path."""
    return not isinstance(body, Vehicle)


def _columns(model: Model, role: str) -> tuple[int, ...]:
    named = model.roles.get(role, ())
    names = (named,) if isinstance(named, str) else named
    return tuple(model.state_names.index(name) for name in names if name in model.states)


def _lengths(model: Model, count: int) -> tuple[float, ...]:
    """Return the lengths of the links [m], 0 where unknown."""
    metres = {name.lower(): p.value for name, p in model.params.items() if p.unit == "m"}
    shared = metres.get("l", metres.get("length", 0.0))
    if len(metres) == count == 1:
        shared = next(iter(metres.values()))
    return tuple(metres.get(f"l{i}", shared) for i in range(1, count + 1))


@dataclass(frozen=True, eq=False)
class Vehicle:
    """A mark along a path, drawn as a car, an aircraft, or a dot."""

    scene: Scene
    size: float
    watched = "the position"

    @property
    def unit(self) -> str:
        """The unit of the first axis."""
        return self.scene.units[0]

    @property
    def parts(self) -> Sequence[Part]:
        """The single part."""
        if not self.scene.spatial:
            return (Part("", "dot"),)
        drawn = AIRCRAFT if self.scene.volume else CAR
        return (Part("", "lines", strips=tuple(self.size * np.array(s) for s in drawn)),)

    def poses(self, states: Array) -> list[Pose]:
        """Return the pose given by position, and heading or attitude."""
        return [(self.scene.points(states), self.scene.rotations(states))]

    def path(self, states: Array) -> Array:
        """Return the positions (T, 3)."""
        return self.scene.points(states)


@dataclass(frozen=True, eq=False)
class Links:
    """A chain of links in the plane of x and z, optionally on a carriage along x."""

    angles: tuple[int, ...]  # indices of the states
    lengths: tuple[float, ...]
    zero: float  # [rad] direction of the first link at angle zero, from x towards z
    sign: int
    unit: str
    rail: tuple[int, ...] = ()  # index of the carriage's state, or empty
    wide: float = CARRIAGE[0]  # half width of the carriage
    drives: bool = False  # whether the carriage is a vehicle's wheels, as of a balancing robot

    @property
    def hangs(self) -> bool:
        """Whether it is a load on ropes below a carriage, as of a crane."""
        return bool(self.rail) and (self.zero, self.sign) == ZEROS["hanging"]

    @property
    def watched(self) -> str:
        """The end of the last link; of a vehicle, whose link ends nowhere, its position."""
        if self.drives:
            return "the position"
        return "the load" if self.hangs else "the tip"

    @property
    def parts(self) -> Sequence[Part]:
        """The links or ropes, the load if there is one, then the carriage."""
        longest = max(self.lengths)
        thin = longest * (ROPE if self.hangs else SLIM)
        links = [
            Part(f"link{i}", "capsule", (thin, length)) for i, length in enumerate(self.lengths, 1)
        ]
        load = [Part("load", "box", (LOAD * longest,) * 3)] * self.hangs
        size = tuple(self.wide / CARRIAGE[0] * part for part in CARRIAGE)
        return [*links, *load, *[Part("carriage", "box", size)] * bool(self.rail)]

    def poses(self, states: Array) -> list[Pose]:
        """Return the pose of each link at its joint, with z along it; the load's, the carriage's.

        The load turns with the rope that it hangs on.
        """
        joints, along = self._chain(states)
        found: list[Pose] = []
        for joint, angle in zip(joints, along, strict=False):
            cos, sin, no = np.cos(angle), np.sin(angle), np.zeros(len(angle))
            columns = [(sin, no, -cos), (no, no + 1, no), (cos, no, sin)]
            turned = np.stack([np.stack(c, axis=-1) for c in columns], axis=-1)
            found.append((joint, turned))
        load = [(joints[-1], found[-1][1])] * self.hangs
        still = np.tile(np.eye(3), (len(states), 1, 1))
        return [*found, *load, *[(joints[0], still)] * bool(self.rail)]

    def path(self, states: Array) -> Array:
        """Return the positions of the watched point (T, 3)."""
        chain = self._chain(states)[0]
        return chain[0] if self.drives else chain[-1]

    def end(self, states: Array) -> Array:
        """Return the positions of the last link's end (T, 3)."""
        return self._chain(states)[0][-1]

    def _chain(self, states: Array) -> tuple[list[Array], list[Array]]:
        """Return positions of joints and tip (T, 3), and each link's angle from x to z (T,)."""
        base = np.zeros((len(states), 3))
        if self.rail:
            base[:, 0] = states[:, self.rail[0]]
        turned = self.zero + self.sign * np.cumsum(states[:, list(self.angles)], axis=1)
        joints = [base]
        for length, angle in zip(self.lengths, turned.T, strict=True):
            step = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
            joints.append(joints[-1] + length * step)
        return joints, list(turned.T)


@dataclass(frozen=True, eq=False)
class Cabin:
    """A cabin that moves up and down."""

    height: int  # index of the state
    size: float
    unit: str
    watched = "its middle"

    @property
    def parts(self) -> Sequence[Part]:
        """A box."""
        return (Part("cabin", "box", (self.size, self.size, 1.4 * self.size)),)

    def poses(self, states: Array) -> list[Pose]:
        """Return its pose at its height."""
        return [(self.path(states), np.tile(np.eye(3), (len(states), 1, 1)))]

    def path(self, states: Array) -> Array:
        """Return the positions of its middle (T, 3)."""
        found = np.zeros((len(states), 3))
        found[:, 2] = states[:, self.height]
        return found


def reach(body: Body, states: Array) -> Array:
    """Return points (k, 3) that a body reaches in the finite ones of some states."""
    path = body.path(states)
    known = states[np.isfinite(path).all(axis=1)]
    filled = np.where(np.isfinite(known), known, 0.0)
    if not len(known) or not is_mechanism(body):
        return path[np.isfinite(path).all(axis=1)]
    chosen = filled[np.unique(np.linspace(0, len(filled) - 1, 60).astype(int))]
    origins = [origin for origin, _ in body.poses(chosen)]
    ends = [body.end(chosen)] if isinstance(body, Links) and body.drives else []
    return np.vstack([path[np.isfinite(path).all(axis=1)], *origins, *ends])
