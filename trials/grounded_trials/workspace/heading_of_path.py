"""Compares the heading of a target with the course of its positions: is it in degrees?"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded.instruments.finding import DEGREES
from grounded.model import Model
from grounded.places import role

MOVING = 0.1  # of the fastest step: slower ones have no course
TURNS = 0.05  # rad: a course that changes less, in rms, shows no unit
FITS = 0.2  # of that change: rms difference up to which a heading in degrees follows the course
LEFT = 0.5  # of that change: difference from which on a heading in radians does not
FRAMES = ((1.0, 0.0), (-1.0, 0.0), (-1.0, math.pi / 2))  # from x; clockwise; a compass: from y


def refuse_degrees(columns: Mapping[str, Array], model: Model) -> None:
    """Refuse a target whose heading fits the course of its positions only as degrees.

    Only models that declare the roles heading and position are checked. The course may be driven
    backwards, and a heading may be counted clockwise, from x or from y. A robot that moves sideways
    has any heading: it then fits neither way, and nothing is refused.

    Args:
        columns: the desired values, (H + 1,) each.
        model: whose heading is in rad.

    Raises:
        GroundedError: naming the largest heading and that of the course.
    """
    name, position = next(iter(role(model, "heading")), ""), role(model, "position")[:2]
    if model.states.get(name) != "rad" or len(position) < 2:
        return
    if not {name, *position} <= columns.keys():
        return
    steps = np.diff([columns[axis] for axis in position], axis=1)
    far = np.hypot(*steps)
    moves = far > MOVING * far.max()
    if not moves.any():
        return
    course = np.arctan2(steps[1], steps[0])[moves]
    heading = columns[name][:-1][moves]
    turned = _off(course, np.angle(np.exp(2j * course).mean()) / 2)
    if turned < TURNS or _nearest(course, heading) < LEFT * turned:
        return
    if _nearest(course, heading / DEGREES) > FITS * turned:
        return
    most = float(np.abs(columns[name]).max())
    raise GroundedError(
        f"the target's {name} goes to {most:.4g} rad, which does not fit the course of its "
        f"positions ({', '.join(position)}); divided by 57.3 it does, so it is in degrees: "
        f"multiply it by pi / 180 = {1 / DEGREES:.8g}"
    )


def _nearest(course: Array, heading: Array) -> float:
    """Return the rms difference of a course from a heading in the frame that fits best [rad]."""
    return min(_off(course, sign * heading + offset) for sign, offset in FRAMES)


def _off(course: Array, heading: Array | float) -> float:
    """Return the rms difference of two angles, forwards or backwards alike [rad]."""
    return float(np.sqrt(np.mean((np.angle(np.exp(2j * (course - heading))) / 2) ** 2)))
