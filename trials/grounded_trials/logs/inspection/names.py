"""How well the name of a number fits a state or input: usual names, in any order of words.

The usual names stand in `names.toml`.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Sequence
from importlib.resources import files

from grounded_trials.logs.inspection.inspect_log import FieldReport, TopicReport
from grounded_trials.logs.log_paths import CSV, FORMATS
from grounded_trials.logs.stated_units import bare_command, without_role, without_unit

MEASURED = ("/Odometry", "/Imu")  # messages that hold no commands

_NAMES = tomllib.loads(files(__package__).joinpath("names.toml").read_text("utf-8"))
_MEANINGS: dict[str, list[str]] = _NAMES["meanings"]
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
# topics of tables: a column's name says it all
TABLES = {"run", *(one.writes for one in (CSV, *FORMATS) if one.writes)}
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
    usual = (*_MEANINGS.get(name, (name,)), *_NAMES["units"].get(unit, ()))
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
