"""Units of a log's numbers against those of the model: stated, or by ROS's conventions.

What a CSV's first row says in brackets, `x [mm]`, is no guess, and the end of a name hardly one:
where either names a multiple of the model's unit, [log] gets the factor between the two. Units that
are no multiples of each other say nothing.

What ROS's messages measure their names say (REP 103: metres, radians, seconds). A JointState's
position is in radians where the joint turns and in metres where it slides, which the joint's name
may say: `joint_units` of joint_names.py. A field `angle` is an angle in any message, if not surely
one in radians: it is no length.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from grounded_trials.formats.name_endings import ENDINGS, unit_ending
from grounded_trials.formats.text_tables import column_units

_OF = {  # a multiple of another unit, itself a product
    "mm": ("m", 1e-3),
    "cm": ("m", 1e-2),
    "km": ("m", 1e3),
    "deg": ("rad", math.pi / 180),
    "degree": ("rad", math.pi / 180),
    "degrees": ("rad", math.pi / 180),
    "°": ("rad", math.pi / 180),
    "Grad": ("rad", math.pi / 180),
    "mrad": ("rad", 1e-3),
    "rpm": ("rad/s", 2 * math.pi / 60),
    "U": ("rad", 2 * math.pi),
    "dps": ("rad/s", math.pi / 180),
    "us": ("s", 1e-6),
    "ms": ("s", 1e-3),
    "min": ("s", 60.0),
    "h": ("s", 3600.0),
    "mV": ("V", 1e-3),
    "mA": ("A", 1e-3),
    "mN": ("N", 1e-3),
    "mNm": ("N m", 1e-3),
    "kN": ("N", 1e3),
    "g": ("kg", 1e-3),
    "Nm": ("N m", 1.0),
    "%": ("1", 0.01),
}

_ROLES = re.compile(  # what a command is to its robot: its unit may stand before that, or after
    r"_(?:cmd|command|commanded|ref|reference|target|setpoint|sp|desired|des|goal|request|req)$"
)
_SHORT = ("s", "V", "A", "N")  # may be part of a name as well: `vel_N`
_NUMBER = re.compile(r"(?:\.(?:data|value))?(?:\[-?\d+\])*\"?$")  # what follows a number's name
TURNING = {"position": "rad", "velocity": "rad/s", "effort": "N m"}  # of a joint
SLIDING = {"position": "m", "velocity": "m/s", "effort": "N"}
UNITS = (  # what the end of a path measures
    (r"(position|translation)\.[xyz]$", "m"),
    (r"@rpy\.\w+$|steering_angle$", "rad"),
    (r"angular_velocity\.[xyz]$|angular\.[xyz]$|steering_angle_velocity$", "rad/s"),
    (r"linear_acceleration\.[xyz]$|accel\.linear\.[xyz]$", "m/s^2"),
    (r"linear\.[xyz]$|drive\.speed$", "m/s"),
)
ANGLE = re.compile(r"(^|[._/])(angle|angular_position|swing|tilt|pitch|roll|yaw|heading)$")
LENGTHS = ("m", "m/s")


@dataclass(frozen=True)
class Stated:
    """The units that a log states by message path: in a table's first row, or by a name's end."""

    heads: Mapping[str, str]

    @classmethod
    def by(cls, files: Sequence[str | Path]) -> Stated:
        """What a log's files state; names do so in every log."""
        return cls(column_units(Path(files[0])) if files else {})

    def unit(self, path: str) -> str:
        """The unit of a number, "" where none is stated."""
        return self.heads.get(path) or unit_in_name(path)

    def factor(self, path: str, wanted: str) -> float:
        """What makes the model's unit of a number in the log's; 1 where nothing is stated."""
        found = factor_between(said, wanted) if (said := self.unit(path)) else None
        return 1.0 if found is None else found

    def by_whom(self, path: str) -> str:
        """What states it, for a sentence."""
        return "the log" if path in self.heads else "its name"


def unit_in_name(path: str) -> str:
    """The unit that the last name of a message path ends with, `/csv.x_mm`; "" for none."""
    return ENDINGS.get(_parts(path)[1] or _parts(without_role(path))[1], "")


def without_unit(path: str) -> str:
    """A message path without the unit that its last name ends with, where that is surely one."""
    bare, ending = _parts(path)
    return bare if ending and ending not in _SHORT else path


def without_role(path: str) -> str:
    """A message path without what says that a number is a command, `steering_pct_cmd`."""
    whole = _NUMBER.sub("", path)
    bare = _ROLES.sub("", whole)
    return path if bare == whole or bare.endswith((".", "/")) else bare


def bare_command(path: str) -> str:
    """A message path without its unit and what says that it is a command, in either order."""
    return without_role(without_unit(without_role(path)))


def _parts(path: str) -> tuple[str, str]:
    """A path without the ending of its last name, and that ending."""
    whole = _NUMBER.sub("", path)
    ending = unit_ending(re.split(r"[./]", whole)[-1])
    return (whole[: -len(ending) - 1], ending) if ending else (path, "")


def factor_between(said: str, wanted: str) -> float | None:
    """By what a number in one unit is multiplied to be in another; None where that makes no sense.

    Args:
        said: as a log writes it, such as "mm/s" or "deg/s^2".
        wanted: as the model has it.
    """
    (a, one), (b, other) = _in_base(said), _in_base(wanted)
    return one / other if a == b else None


def same_unit(said: str, wanted: str) -> bool:
    """Whether two ways of writing a unit mean one: `N·m`, `Nm` and `N m`."""
    factor = factor_between(said, wanted)
    return factor is not None and math.isclose(factor, 1.0)


def _in_base(unit: str) -> tuple[Counter[str], float]:
    """The powers of a unit's parts that are no multiples of others, and its size in those."""
    powers, size = Counter[str](), 1.0
    for k, side in enumerate(unit.replace("²", "^2").replace("·", " ").split("/")):
        for part in re.findall(r"[^\s*^()]+(?:\^-?\d)?", side):
            name, _, power = part.partition("^")
            sign = (-1 if k else 1) * int(power or 1)
            inner, by = _in_base(_OF[name][0]) if name in _OF else (Counter({name: 1}), 1.0)
            size *= (by * _OF.get(name, ("", 1.0))[1]) ** sign
            for base, count in inner.items():
                powers[base] += sign * count
    return Counter({base: n for base, n in powers.items() if n and base != "1"}), size


def unit_of(path: str, joints: Mapping[str, str] | None = None) -> str:
    """The unit of a path's number, "" where no convention gives one.

    Args:
        path: of a message.
        joints: units of joints' numbers by their paths, where the joints' names are known.
    """
    if joints and path in joints:
        return joints[path]
    for pattern, unit in UNITS:
        if re.search(pattern, path):
            return unit
    found = re.search(r"\.(position|velocity|effort)\[\d+\]$", path)
    return TURNING[found[1]] if found else ""


def is_angle(path: str) -> bool:
    """Whether a number is called an angle, of whichever unit."""
    return bool(ANGLE.search(path.lower()))


def may_be(path: str, unit: str, joints: Mapping[str, str] | None = None) -> bool:
    """Whether a number may be a state in some unit: an angle is no length, nor a slide a turn.

    Args:
        path: of a message.
        unit: of the state.
        joints: see `unit_of`.
    """
    if unit in LENGTHS and is_angle(path):
        return False
    known = unit_of(path, joints)
    return not (known and unit not in ("", "1")) or factor_between(known, unit) is not None
