"""Find signals that [log] reads from another kind of column, by the columns' names alone.

The data may not show it. The z of an orientation is sin(yaw / 2): as smooth as a yaw, about half as
large, but different beyond a quarter turn, which can't be told from a gain. A length that is read
from a column of angles is none either.
"""

from __future__ import annotations

import re

from grounded.findings import Finding, found
from grounded.model import Model
from grounded_trials.logs.log_table import LogMapping
from grounded_trials.logs.stated_units import LENGTHS, is_angle

PART = re.compile(r"((?:^|[._])(?:orientation|rotation|quaternion))\.([xyzw])$")
ABOUT = {"x": "roll", "y": "pitch", "z": "yaw", "w": "yaw"}  # the angle closest to each component
SMALL_ANGLE_SCALE = 2.0  # a scale of 2 is intended: 2 sin(a / 2) is a for small angles


def misread(model: Model, mapping: LogMapping | None) -> list[Finding]:
    """Return angles that are read from a part of a quaternion, and lengths from angles.

    Args:
        model: the model with the states.
        mapping: the column of each signal; None if there is no [log].
    """
    some = []
    for name, one in (mapping.states if mapping else {}).items():
        unit, part = model.states.get(name, ""), PART.search(one.path)
        angle = name in model.angles or unit in ("rad", "deg")
        if unit in LENGTHS and is_angle(one.path) and one.scale == 1:
            some.append(found("log.path", name, path=one.path, what="an angle"))
        elif part and angle and abs(one.scale) != SMALL_ANGLE_SCALE:
            instead = f"{one.path[: part.end(1)]}.@rpy.{ABOUT[part[2]]}"
            what = "a part of a quaternion"
            some.append(found("log.path", name, path=one.path, what=what, instead=instead))
    return some
