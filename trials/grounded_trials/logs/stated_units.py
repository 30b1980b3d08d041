"""Units of a log's numbers: as names state them, or by the conventions of ROS.

A unit at the end of a name is nearly certain. If it is a multiple of the model's unit, [log] gets
the factor between the two. The fields of ROS messages have fixed units (REP 103: metres, radians,
seconds); those of joints follow from their names: `joint_units` in `inspection`. A field `angle` is
an angle in any message, though perhaps not in radians; it is not a length.
"""

from __future__ import annotations

import re

from grounded.units import ENDINGS, unit_ending

_ROLES = re.compile(  # suffixes that mark a command; its unit may come before or after them
    r"_(?:cmd|command|commanded|ref|reference|target|setpoint|sp|desired|des|goal|request|req|ctrl)$"
)
_SENT = re.compile(r"(?<=[./])(?:cmd|command|commanded|desired|target|setpoint|ref)_(?=[a-zA-Z])")
_SHORT = ("s", "V", "A", "N", "C")  # may be part of a name as well: `vel_N`
_NUMBER = re.compile(r"(?:\.(?:data|value))?(?:\[-?\d+\])*\"?$")  # what may follow a name
TURNING = {"position": "rad", "velocity": "rad/s", "effort": "N m"}  # of a joint
SLIDING = {"position": "m", "velocity": "m/s", "effort": "N"}
UNITS = (  # units by the end of a path
    (r"(position|translation)\.[xyz]$", "m"),
    (r"@rpy\.\w+$|steering_angle$", "rad"),
    (r"angular_velocity\.[xyz]$|angular\.[xyz]$|steering_angle_velocity$", "rad/s"),
    (r"linear_acceleration\.[xyz]$|accel\.linear\.[xyz]$", "m/s^2"),
    (r"/[^/.]*(accel|acceleration)\.(xyz\[\d\]|[xyz])$|accelerometer_m_s2\[\d\]$", "m/s^2"),
    (r"/[^/.]*gyro\.[xyz]$|gyro_rad\[\d\]$|angular_velocity\.xyz\[\d\]$", "rad/s"),
    (r"/[^/.]*mag(netometer)?\.(\w+\[\d\]|[xyz])$|magnetometer_ga\[\d\]$", "T"),
    (r"linear\.[xyz]$|@world_velocity\.[xyz]$|drive\.speed$", "m/s"),
    *((rf"\.{kind}\[\d+\]$", unit) for kind, unit in TURNING.items()),
)
ANGLE = re.compile(r"(^|[._/])(angle|angular_position|swing|tilt|pitch|roll|yaw|heading)$")
LENGTHS = ("m", "m/s")


def unit_in_name(path: str) -> str:
    """Return the unit at the end of a message path's last name, as in `/csv.x_mm`; "" for none."""
    return ENDINGS.get(_parts(path)[1] or _parts(without_role(path))[1], "")


def without_unit(path: str) -> str:
    """Return a message path without the unit at the end of its last name, unless ambiguous."""
    bare, ending = _parts(path)
    return bare if ending and ending not in _SHORT else path


def without_role(path: str) -> str:
    """Return a path without what marks a command, as in `steering_pct_cmd` and `/csv.cmd_v`."""
    whole = _NUMBER.sub("", path)
    bare = _ROLES.sub("", _SENT.sub("", whole))
    return path if bare == whole or bare.endswith((".", "/")) else bare


def bare_command(path: str) -> str:
    """Return a message path without its unit and what marks a command, in either order."""
    return without_role(without_unit(without_role(path)))


def _parts(path: str) -> tuple[str, str]:
    """Return a path without the unit ending of its last name, and that ending."""
    whole = _NUMBER.sub("", path)
    ending = unit_ending(re.split(r"[./]", whole)[-1])
    return (whole[: -len(ending) - 1], ending) if ending else (path, "")


def unit_of(path: str) -> str:
    """Return the unit of a path's number by convention, "" if there is none."""
    return next((unit for pattern, unit in UNITS if re.search(pattern, path)), "")


def is_angle(path: str) -> bool:
    """Check whether a number's name is that of an angle, in any unit."""
    return bool(ANGLE.search(path.lower()))
