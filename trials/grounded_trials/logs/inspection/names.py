"""How well the name of a number fits a state or input: usual names, in any order of words."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from grounded_trials.formats.message_path import AXES, WORLD
from grounded_trials.logs.inspection.inspect_log import FieldReport, TopicReport
from grounded_trials.logs.stated_units import bare_command, without_role, without_unit

MEASURED = ("/Odometry", "/Imu")  # messages that hold no commands

_YAW = ("@rpy.yaw", "yaw", "heading", "theta", "psi")
_TURN = ("@rpy.pitch", "@rpy.yaw", "theta", "angle", "pitch", "tilt", "lean")
_MEANINGS: dict[str, tuple[str, ...]] = {
    "x": ("position.x", "translation.x", "x", "north", "northing", "east", "easting", "x0", "pos"),
    "y": ("position.y", "translation.y", "y", "east", "easting", "north", "northing", "y0"),
    "z": ("position.z", "translation.z", "z", "altitude", "height"),
    "psi": _YAW,
    "yaw": _YAW,
    "heading": _YAW,
    "theta": _TURN,
    "th": _TURN,
    "pitch": ("@rpy.pitch", "pitch", "theta", "tilt", "lean"),
    "pitch_rate": (
        *("angular.y", "angular_velocity.y", "pitch_rate", "pitch_velocity"),
        *("tilt_rate", "lean_rate"),
    ),
    "phi": ("@rpy.roll", "roll", "phi"),
    "roll": ("@rpy.roll", "roll", "phi"),
    **{f"v{axis}": (f"@{WORLD}.{axis}", f"linear.{axis}", f"v{axis}") for axis in AXES},
    "v": ("linear.x", "speed", "velocity", "vel", "v"),
    "speed": ("speed", "linear.x", "velocity", "vel", "v"),
    "u": ("linear.x", "u", "surge"),
    "w": ("linear.z", "w", "heave"),
    "p": ("angular.x", "angular_velocity.x", "p"),
    "q": ("angular.y", "angular_velocity.y", "q"),
    "r": ("angular.z", "angular_velocity.z", "yaw_rate", "r"),
    "omega": ("angular.z", "angular_velocity.z", "yaw_rate", "omega"),
    "yaw_rate": ("angular.z", "angular_velocity.z", "yaw_rate"),
    "delta": ("steering_angle", "delta", "steering"),
    "steering": ("steering", "steering_angle", "steer", "delta", "angular.z"),
    "turn": ("turn", "angular.z", "angular_velocity.z", "turn_rate", "yaw_rate", "omega", "w"),
    "throttle": ("throttle", "gas", "accelerator", "acceleration", "motor"),
    "thrust": ("thrust", "force.z", "throttle"),
    "torque": ("torque", "effort", "tau"),
}
NAMES_BY_UNIT: dict[str, tuple[str, ...]] = {  # further names of an input by its unit
    "V": ("voltage", "volts", "volt"),
    "A": ("current", "amps", "ampere"),
    "N m": ("torque", "effort", "tau"),
    "N": ("force", "thrust"),
}
_BESIDE_U = ("linear.y", "v", "sway")  # meaning of v beside a state u: sway, not the speed
_COMPASS = (("north", "northing"), ("east", "easting"))  # axes of a plane; either may be x
_COMMANDED = (
    *("ref", "reference", "desired", "des", "target", "setpoint", "goal", "cmd", "command"),
    *("action", "output"),
)
COMMAND_TOPIC = re.compile("control|cmd|command|setpoint|ref|target|^/action$")
# no signals by themselves
PARTS = re.compile(
    r"covariance|variance|\.error\.(positions|velocities|accelerations|effort)\[|_var(\[\d+\])?$|\.(eph|epv|evh|evv)$|layout"
    r"|(orientation|rotation|quaternion)\.[xyzw]$|\.q(_d)?\[\d\]$"
)
POSES = ("/PoseStamped", "/PoseWithCovarianceStamped", "/TransformStamped")
_WORD = re.compile(r"[a-z]+")
TABLES = ("npz", "csv", "parquet", "mat", "run")  # topics of tables: a column's name says it all
WORTH, LESS = 4.0, 0.3  # points of the usual name, less of each further one


def meanings(name: str, unit: str, paths: Iterable[str], states: Sequence[str]) -> tuple[str, ...]:
    """Return the usual names of a state or input, its own first.

    An input may be called by its `unit`, "" for a state. North and east are axes only if the log
    has both; beside a state u, the surge, v is the sway.
    """
    if name == "v" and "u" in states:
        return (name, *_BESIDE_U)
    said = {without_unit(path).lower().rpartition(".")[2] for path in paths}
    plane = all(said.intersection(axis) for axis in _COMPASS)
    left = () if plane else {one for axis in _COMPASS for one in axis}
    usual = (*_MEANINGS.get(name, (name,)), *NAMES_BY_UNIT.get(unit, ()))
    return (name.lower(), *(one for one in usual if one not in left))


def name_points(
    called: Sequence[str], name: str, topic: TopicReport, field: FieldReport, *, is_input: bool
) -> float:
    """Return how well a number's name fits, 0 for not at all."""
    plain, on = bare_command if is_input else without_unit, topic.topic.lower()
    ways = {one[len(on) :].lower().strip('".') for one in (field.path, plain(field.path))}
    best = max(_fit(called, one, on) for one in ways)
    state = without_role(name)  # the command of a state, such as roll_command
    if best <= 0 and is_input and state != name and COMMAND_TOPIC.search(on):
        best = max(_fit((state, *_MEANINGS.get(state, ())), one, on) for one in ways)
    if best <= 0 or is_input:
        return max(best, 0.0)
    commanded = not {*_WORD.findall(field.path.lower())}.isdisjoint(_COMMANDED)
    return best - 2.0 * commanded + 0.5 * topic.stamped


def _fit(called: Sequence[str], inside: str, topic: str) -> float:
    """Score how well a name fits: by the end of the path, or by the topic if that is generic."""
    last = re.sub(r"[_\d]+$", "", topic.rsplit("/", 1)[-1])
    table = last in TABLES and not {".", "["} & {*inside}
    whole = last if inside in ("data", "value") else inside * table
    words, best = _WORD.findall(whole), 0.0
    for rank, meaning in enumerate(called):
        worth = WORTH - LESS * max(rank - 1, 0)
        if inside == meaning or inside.endswith("." + meaning):
            best = max(best, worth + 0.5 * ("." in meaning))
        elif whole == meaning or (len(meaning) > 1 and meaning in words):
            best = max(best, worth - 1.0 * (whole != meaning))
    return best
