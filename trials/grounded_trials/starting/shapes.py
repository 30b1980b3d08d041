"""Draws targets: paths with limited speed and acceleration, and steps.

A path is parametrised by its length. The speed starts at zero, rises with `accel`, and is limited
by `speed` and, in curves, by sqrt(lateral / curvature). Every state with one of the roles position,
heading, speed and heading_rate gets a column.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from grounded import places
from grounded.checks import known, positive, refused, wrong
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import rate_states
from grounded.places import velocities as velocities_of
from grounded.task import MAX_HORIZON
from grounded_trials.workspace.off_target import position_names

PATHS = ("line", "circle", "figure-8")
SHAPES = (*PATHS, "step")
FEWEST = 5  # control steps of a target; at most MAX_HORIZON
FINE = 2000  # number of points of a path


@dataclass(frozen=True)
class Drive:
    """Size, speed limits and timing of a path, in SI units."""

    size: float = 2.0  # [m] length of a line, radius of a circle, half the width of an 8's loops
    speed: float = 1.0  # [m/s] limit
    accel: float = 1.0  # [m/s^2] along the path
    lateral: float = 4.0  # [m/s^2] across it
    laps: float = 1.0
    hold: float = 0.0  # [s] of rest at the end


def path_target(
    shape: str,
    drive: Drive,
    model: Model,
    dt: float,
    to: Mapping[str, float] = MappingProxyType({}),
    start: Mapping[str, float] = MappingProxyType({}),
) -> dict[str, Array]:
    """Return the columns of a target, (H + 1,) each, that follows a path in the plane from rest.

    Args:
        shape: line, circle or figure-8.
        drive: size and speeds of the path.
        model: its roles name the states.
        dt: control interval [s].
        to: further states, each with the value that it keeps along the path: a drone's height. A
            velocity follows the path instead, and must end at its value: 0 with `drive.hold`.
        start: [task] start: where the path begins, and the height unless `to` gives one.

    Raises:
        GroundedError: if the model has no position, a number is not positive, `to` names a state of
            the path, or a position of three states has no height.
    """
    position = model.roles.get("position", ())
    if len(position) < 2:
        raise refused("start.no_position", model.name, shape=shape, roles=_roles(model))
    ahead, across = places.body_velocity(model) or ("", "")
    if across and model.roles.get("speed") == across:
        raise refused("start.sideways", model.name, speed=across, ahead=ahead)
    _check(drive)
    along, x, y, heading = _path(shape, drive)
    curvature = np.gradient(heading, along)
    limit = np.minimum(drive.speed, np.sqrt(drive.lateral / np.maximum(abs(curvature), 1e-9)))
    limit[-1] *= not drive.hold
    speed = _reachable(along, limit, drive.accel)
    _, far, pace = _driven(along, speed, drive.hold, dt)
    columns = {
        name: start.get(name, 0.0) + np.interp(far, along, way)
        for name, way in zip(position, (x, y), strict=False)
    }
    bend, turned = (np.interp(far, along, course) for course in (curvature, heading))
    for role, values in {"heading": turned, "speed": pace, "heading_rate": bend * pace}.items():
        played = model.roles.get(role)
        if isinstance(played, str) and played in model.states:
            columns[played] = values

    # What keeps a value: as `to` says, and the height.
    held = _placed(to, model, bool(drive.hold))
    for name in held:
        if name in columns:
            raise refused("start.follows_path", name, asked=f"{to[name]:g}", why="path")
    for height in position[2:]:
        if height not in {**start, **to}:
            raise wrong(f"--to {height}", must="given", like=f"--to {height}=1.5")
        held.setdefault(height, start.get(height, 0.0))
    return columns | {name: np.full(len(far), value) for name, value in held.items()}


def _roles(model: Model) -> str:
    """Return the roles to declare, of the states that the model's equations show in them."""
    x, y = (*places.position(model), "x", "y")[:2] if len(places.position(model)) > 1 else "xy"
    ahead = (*places.body_velocity(model), places.speed(model) or "v")[0]
    turned = places.heading(model) or "psi"
    return f'roles={{"position": ("{x}", "{y}"), "heading": "{turned}", "speed": "{ahead}"}}'


def _driven(
    along: Array, speed: Array, hold: float, dt: float, seconds: float | None = None
) -> tuple[Array, Array, Array]:
    """Return times on the grid (H + 1,), and the way covered and the speed there.

    The speed is linear in time between the points of a path, at which `along` and `speed` are
    given. A path that ends in motion is driven a little more slowly, by less than a step in all, so
    that it ends with a whole step. `seconds`: its duration without `hold`; None: by these speeds.
    """
    lasts = 2 * np.diff(along) / np.maximum(speed[1:] + speed[:-1], 1e-6)
    when = np.concatenate([[0.0], np.cumsum(lasts)])
    t = _grid((seconds or when[-1]) + hold, dt)
    slower = (seconds or (t[-1] if speed[-1] > 0 else when[-1])) / when[-1]
    when, speed, lasts = when * slower, speed / slower, lasts * slower
    i = np.clip(np.searchsorted(when, t, side="right") - 1, 0, len(lasts) - 1)
    part = np.minimum((t - when[i]) / lasts[i], 1.0)
    pace = speed[i] + part * (speed[i + 1] - speed[i])
    return t, along[i] + part * lasts[i] * (speed[i] + pace) / 2, pace


def _placed(to: Mapping[str, float], model: Model, at_rest: bool) -> dict[str, float]:
    """Return what --to asks of states that are no velocities, which follow a line or path.

    A velocity must end as the line or path does.
    """
    _check_states(to, model)
    moving = [name for name in to if name in velocities_of(model)]
    for name in moving:
        if to[name] or not at_rest:
            why = "rest" if at_rest else "ends"
            facts = {"why": why, "rate": 1, "hold": int(not to[name])}
            raise refused("start.follows_path", name, asked=f"{to[name]:g}", **facts)
    return {name: value for name, value in to.items() if name not in moving}


def _check(drive: Drive) -> None:
    for name, value in vars(drive).items():
        if not (0 < value < np.inf or (name == "hold" and value == 0)):
            raise wrong(f"--{name}", value, must="positive")


def _grid(seconds: float, dt: float) -> Array:
    steps = in_steps(seconds, dt, float(np.ceil(seconds / dt - 1e-6)))
    return dt * np.arange(steps + 1.0)


def in_steps(seconds: float, dt: float, steps: float) -> int:
    """Return a target's number of control steps as an integer; refuse too few or too many."""
    if FEWEST <= steps <= MAX_HORIZON:
        return int(steps)
    what = f"number of control steps (dt = {dt:g} s) in {seconds:.4g} s"
    raise wrong(what, got=f"{steps:.4g}", low=FEWEST, high=MAX_HORIZON)


def line_target(
    to: Mapping[str, float],
    start: Mapping[str, float],
    drive: Drive,
    model: Model,
    dt: float,
    seconds: float | None = None,
) -> dict[str, Array]:
    """Return the columns, (H + 1,) each, of a straight line from rest to rest, with their rates.

    If one coordinate of a position is named, the others stay at their start values. A velocity
    beside them follows the line, and ends at 0.

    Args:
        to: end value by state; empty: `drive.size` further along the model's only axis.
        start: start values of states that do not start at 0.
        drive: speed and acceleration of the state that moves farthest, in its unit.
        model: the model of the states.
        dt: control interval [s].
        seconds: duration from rest to rest [s]; None: determined by `drive`.

    Raises:
        GroundedError: for an unknown state, a line of zero length, an ambiguous axis, a duration
            that is not positive, or a velocity of what the line moves that is not to end at 0.
    """
    _check(drive)
    to = to or {(name := _axis(model)): start.get(name, 0.0) + drive.size}
    _check_states(to, model)
    still = {*to} <= {*velocities_of(model)}  # they are what is moved
    to = to if still else _placed(to, model, at_rest=True)
    way = {name: value - start.get(name, 0.0) for name, value in to.items()}
    length, rates, place = max(map(abs, way.values())), rate_states(model), position_names(model)
    if not 0 < length < np.inf:
        there = ", ".join(f"{name} = {value:g}" for name, value in to.items())
        goes = next((q for q in (*place, *rates) if q not in to), "")
        raise wrong("--to", got=there, must="way", like=f"{goes}=1.0" if still and goes else None)
    if seconds is not None:
        # as gently as `drive`, at the least it accelerates to the middle, then decelerates
        positive("--seconds", seconds)
        accel = max(drive.accel, 4 * length / seconds**2)
        root = np.sqrt(max((accel * seconds) ** 2 - 4 * accel * length, 0.0))
        drive = replace(drive, accel=accel, speed=float(accel * seconds - root) / 2)
        _grid(seconds + drive.hold, dt)
    along, limit = np.linspace(0, length, FINE), np.full(FINE, drive.speed)
    limit[-1] = 0.0
    speed = _reachable(along, limit, drive.accel)
    t, share, rate = _driven(along, speed, drive.hold, dt, seconds)
    columns = {name: start.get(name, 0.0) + share / length * far for name, far in way.items()}
    way |= dict.fromkeys([q for q in place if q not in way and not {*place}.isdisjoint(way)], 0.0)
    columns |= {q: np.full(len(t), start.get(q, 0.0)) for q in way if q not in columns}
    pace = rate / length
    return columns | {rates[q]: pace * far for q, far in way.items() if rates.get(q, q) not in way}


def has_plane(model: Model) -> bool:
    """Return whether the model has a plane to draw paths in."""
    return len(model.roles.get("position", ())) > 1


def _axis(model: Model) -> str:
    """Return the state along which a line without `--to` runs."""
    named = model.roles.get("position") or model.roles.get("rail") or tuple(rate_states(model))
    moved = (named,) if isinstance(named, str) else named
    if len(moved) == 1:
        return moved[0]
    raise wrong("--to", must="given", like=f"--to {next(iter(moved or model.states))}=1.0")


def _path(shape: str, drive: Drive) -> tuple[Array, Array, Array, Array]:
    """Return length, x, y and heading along a path from the origin that starts along x."""
    a, turn = drive.size, 2 * np.pi * drive.laps * np.linspace(0, 1, FINE)
    if shape == "line":
        s = np.linspace(0, a, FINE)
        return s, s, np.zeros(FINE), np.zeros(FINE)
    if shape == "circle":
        return a * turn, a * np.sin(turn), a * (1 - np.cos(turn)), turn
    x, y = 2 * a * np.sin(turn), a * np.sin(2 * turn)  # a lemniscate of Gerono
    dx, dy = np.gradient(x, turn), np.gradient(y, turn)
    heading = np.unwrap(np.arctan2(dy, dx))
    cos, sin = np.cos(-heading[0]), np.sin(-heading[0])
    along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    return along, cos * x - sin * y, sin * x + cos * y, heading - heading[0]


def _reachable(along: Array, limit: Array, accel: float) -> Array:
    """Return the fastest speed profile within `limit` and `accel` that starts at rest."""
    gain, square = 2 * accel * along, limit**2  # v^2 changes by no more than 2 accel times the way
    square[0] = 0.0
    square = gain + np.minimum.accumulate(square - gain)
    square = np.minimum.accumulate((square + gain)[::-1])[::-1] - gain
    return np.minimum(limit, np.sqrt(np.maximum(square, 0.0)))


def step_target(
    to: Mapping[str, float],
    model: Model,
    dt: float,
    seconds: float,
    start: Mapping[str, float] = MappingProxyType({}),
) -> dict[str, Array]:
    """Return columns with given values from the second row on; the first row is `start`, or 0."""
    if not to:
        raise wrong("--to", must="given", like="--to x=1.0")
    rows = in_steps(seconds, dt, np.round(seconds / dt)) + 1
    _check_states(to, model)
    first = np.arange(rows) < 1
    return {name: np.where(first, start.get(name, 0.0), value) for name, value in to.items()}


def _check_states(to: Mapping[str, float], model: Model) -> None:
    for name in to:
        known("state", [name], model.states, "the model")
