"""Angles that [log] reads from one number of a quaternion, which is no angle.

The z of an orientation is sin(yaw / 2): as smooth as a yaw, about half as large, and from a
quarter turn on something else. No instrument tells it from a gain, but the path does.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from grounded.model import Model
from grounded_trials.logs.log_table import LogMapping
from grounded_trials.workspace.config import FILE

PART = re.compile(r"((?:^|[._])(?:orientation|rotation|quaternion))\.([xyzw])$")
ABOUT = {"x": "roll", "y": "pitch", "z": "yaw", "w": "yaw"}  # the angle that a part says most of
SMALL = 2.0  # times sin(a / 2): a small angle, which somebody who writes that knows


def no_angles(model: Model, mapping: LogMapping | None) -> Mapping[str, str]:
    """States in rad or deg that are read from a part of a quaternion, and what to say of each.

    Args:
        model: whose states they are.
        mapping: which column each is read from; None: nothing is read.
    """
    found = {}
    for name, one in (mapping.states if mapping else {}).items():
        part = PART.search(one.path)
        angle = name in model.angles or model.states.get(name) in ("rad", "deg")
        if part and angle and abs(one.scale) != SMALL:
            instead = f"{one.path[: part.end(1)]}.@rpy.{ABOUT[part[2]]}"
            found[name] = (
                f"is read from {one.path}, a part of a quaternion, which is no angle: "
                f"{instead} is, in {FILE}'s [log.state.{name}]"
            )
    return found
