"""Find signals that [log] reads from wrong columns, by the names of the columns alone.

The data may not show it: a beam's angle read from the servo's column is as smooth as its own. Two
signals count as exchanged if each column's name fits the other signal better, or if the unit of
each path by ROS conventions is that of the other signal. An angle read from a part of a quaternion
is none, and a length read from a column of angles is none either.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import combinations

from grounded.findings import Finding, found
from grounded.model import Model
from grounded_trials.logs.log_table import LogMapping
from grounded_trials.logs.stated_units import LENGTHS, bare_command, is_angle, unit_of

UNNAMED = ("data", "value")  # field names without meaning: the topic is the name
PART = re.compile(r"((?:^|[._])(?:orientation|rotation|quaternion))\.([xyzw])$")
ABOUT = {"x": "roll", "y": "pitch", "z": "yaw", "w": "yaw"}  # the angle closest to each component
SMALL_ANGLE_SCALE = 2.0  # a scale of 2 is intended: 2 sin(a / 2) is a for small angles


def crossed(model: Model, mapping: LogMapping) -> list[Finding]:
    """Return signals that are read from each other's columns, or lengths from angles.

    Axes of a position are exempt, since their names vary.

    Args:
        model: the model with the states and inputs.
        mapping: the column of each signal.
    """
    paths = {name: one.path for name, one in {**mapping.states, **mapping.inputs}.items()}
    units = {**model.states, **model.inputs}
    angles = [n for n, s in mapping.states.items() if is_angle(s.path) and s.scale == 1]
    axes = model.roles.get("position", ())  # north may be the x of one and the y of another
    lengths = [
        found("log.path", n, path=paths[n], what="an angle") for n in angles if units[n] in LENGTHS
    ]
    by = {
        (a, b): "units" if _of_the_other(a, b, paths, units) else "names"
        for a, b in combinations(paths, 2)
        if _of_the_other(a, b, paths, units) or _crossed(a, b, paths)
    }
    return lengths + [
        found("log.path", a, b, paths=(paths[a], paths[b]), by=what)
        for (a, b), what in by.items()
        if not {a, b} <= set(axes)
    ]


def _of_the_other(a: str, b: str, paths: Mapping[str, str], units: Mapping[str, str]) -> bool:
    """Return whether each path's number is in the other signal's unit, and not in its own."""
    read = unit_of(paths[a]), unit_of(paths[b])
    return read == (units[b], units[a]) != (units[a], units[b])


def _crossed(a: str, b: str, paths: Mapping[str, str]) -> bool:
    """Return whether each name fits the other's column better than its own."""
    return all(
        _alike(one, paths[other]) > _alike(one, paths[one])
        and _alike(one, paths[other]) >= _alike(other, paths[other])
        for one, other in ((a, b), (b, a))
    )


def _alike(name: str, path: str) -> float:
    """Return the share of words that a name and the end of a path have in common, without units.

    For a message with a single number, such as `/cmd/port.data`, the topic is the name.
    """
    words = re.split(r"[./]", bare_command(path).strip('"'))
    last = next((one for one in reversed(words) if one and one not in UNNAMED), "")
    own, other = (set(re.findall(r"[a-z]+|\d+", one.lower())) for one in (name, last))
    return len(own & other) / max(len(own | other), 1)


def no_angles(model: Model, mapping: LogMapping | None) -> list[Finding]:
    """Return states in rad or deg that are read from a component of a quaternion.

    The z of an orientation is sin(yaw / 2): as smooth as a yaw, about half as large, but different
    beyond a quarter turn. The data can't distinguish it from a gain, but the path can.

    Args:
        model: the model with the states.
        mapping: the column of each signal; None if there is no [log].
    """
    some = []
    for name, one in (mapping.states if mapping else {}).items():
        part = PART.search(one.path)
        angle = name in model.angles or model.states.get(name) in ("rad", "deg")
        if part and angle and abs(one.scale) != SMALL_ANGLE_SCALE:
            instead = f"{one.path[: part.end(1)]}.@rpy.{ABOUT[part[2]]}"
            what = "a part of a quaternion"
            some.append(found("log.path", name, path=one.path, what=what, instead=instead))
    return some
