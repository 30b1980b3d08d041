"""Guess a [log] table for an unknown log: which number of which topic is which state or input.

Every number of the log is scored against every name: by the words in its path, by common names of
such quantities, by its message type, and by whether it changes at all. States from one message are
preferred to states scattered over many. Numbers that never change, or that have another unit, rank
lower. If the best is not clearly better than the rest, the table says so and lists the rest.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from grounded_trials.formats.message_path import AXES, WORLD
from grounded_trials.logs.inspection.inspect_log import FieldReport, LogReport, TopicReport
from grounded_trials.logs.stated_units import (
    bare_command,
    factor_between,
    in_english,
    may_be,
    unit_in_name,
    unit_of,
    without_role,
    without_unit,
)

FEW = 8  # alternatives listed in [log]
SURE = 1.5  # lead in score over the next candidate, to be sure
AS_OFTEN = 0.5  # of the wheel odometry's rate: a pose at this rate is preferred to the odometry's
LEAST = 2.0  # below this score nothing is proposed
MEASURED = ("/Odometry", "/Imu")  # messages that hold no commands
SIMULATED_S = 1.0  # header stamps further from the log's clock are simulation time

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
    "brake": ("brake",),
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
_RATES = {"rate", "rates", "dot", "vel", "velocity"}  # words of a rate, not of an angle
_COMMANDED = ("ref", "desired", "des", "target", "setpoint", "goal", "cmd", "command")
COMMAND_TOPIC = re.compile("control|cmd|command|setpoint|ref|target")
_ANGLES = ("roll", "pitch", "yaw")
# no signals by themselves
PARTS = re.compile(r"covariance|layout|(orientation|rotation|quaternion)\.[xyzw]$")
_QUATERNION = tuple(f"{name}.{part}" for name in ("orientation", "rotation") for part in "xyzw")
_POSE = ("position.x", "position.y", "@rpy.yaw")
POSES = ("/PoseStamped", "/PoseWithCovarianceStamped", "/TransformStamped")
_NO_WHEELS = re.compile(  # topics with odometry messages that is not from wheels
    "mocap|vicon|optitrack|qualisys|truth|filter|fused|ekf|gps|gnss|slam|lidar|visual|vio"
)
_WORD = re.compile(r"[a-z]+")
_FLAT = re.compile(r"_(linear|angular)_(?=[xyz]$)")  # a Twist in a table: cmd_vel_linear_x
_HUMP = re.compile(r"(?<=[a-z])(?=[A-Z][a-z])")  # between the words of armAngle


@dataclass(frozen=True)
class Guess:
    """The probable signal of a state or input in the log."""

    name: str
    path: str  # "" if nothing fits
    clock: str
    sure: bool
    others: tuple[str, ...]  # alternatives, best first
    field: FieldReport | None = None
    reasons: tuple[str, ...] = ()  # evidence, as phrases for a person
    scale: float = 1.0  # factor on its values: degrees, or a sign

    @property
    def is_angle(self) -> bool:
        """Whether its values come from an orientation and wrap."""
        return self.path.endswith(tuple(f"@rpy.{angle}" for angle in _ANGLES))


@dataclass(frozen=True)
class _Candidate:
    score: float
    topic: TopicReport
    field: FieldReport


def guess_mapping(
    log: LogReport,
    states: Sequence[str],
    inputs: Sequence[str],
    units: Mapping[str, str] = MappingProxyType({}),
) -> tuple[tuple[Guess, ...], tuple[Guess, ...]]:
    """Return guesses for the states and for the inputs, in their order.

    Args:
        log: an inspected log.
        states: names of the states.
        inputs: names of the inputs.
        units: the model's units by name, where known.
    """
    meant = {name: _meanings(log, name, states) for name in states}
    scored = {name: _candidates(log, name, meant[name], is_input=False) for name in states}
    scored = {name: _of_unit(log, some, units.get(name, "")) for name, some in scored.items()}
    for name, some in scored.items():
        if not any(c.score >= LEAST for c in some):
            scored[name] = _of_stem(log, name, units.get(name, "")) or some
    named = {name: _by_name(log, name, units) for name in inputs}
    sent = {_sent(named[name]) for name in inputs}
    scored = {name: [c for c in some if c.field.path not in sent] for name, some in scored.items()}
    homes = _homes(scored)
    found = tuple(_choose(log, name, scored[name], homes) for name in states)
    taken = {guess.path for guess in found}
    rest = []
    for name in inputs:
        candidates = [c for c in named[name] if c.field.path not in taken]
        guess = _choose(log, name, candidates, {})
        rest.append(guess if guess.path or guess.others else commands_of(log, guess, taken))
    if len(rest) == 1:
        rest = [_only_command(log, rest[0], units.get(rest[0].name, ""))]
    return found, tuple(_by_words(log, rest, units))


def _by_words(log: LogReport, inputs: Sequence[Guess], units: Mapping[str, str]) -> list[Guess]:
    """Assign inputs without a fitting name to the only command whose name has all of their words.

    So `voltage` is `motor_voltage`, but not `voltage_rate`. Guesses are unchanged where several
    commands have them, and where another input has that command.
    """
    taken = {guess.path for guess in inputs}
    fits = {
        guess.name: [
            path
            for path in _moving_commands(log, taken)
            if _has_words(path, guess.name) and _may_be(path, units.get(guess.name, ""))
        ]
        for guess in inputs
        if not guess.path and guess.reasons
    }
    claimed = [path for paths in fits.values() for path in paths]
    found = []
    for guess in inputs:
        paths = fits.get(guess.name, [])
        if len(paths) != 1 or claimed.count(paths[0]) > 1:
            found.append(guess)
            continue
        now = replace(guess, sure=True, others=())
        why = "the only command in the log with this word in its name"
        found.append(taking(now, paths[0], log, why))
    return found


def _has_words(path: str, name: str) -> bool:
    """Return whether the last name of a path has all words of a name, and is not their rate."""
    last = re.split(r"[./]", path.lower())[-1]
    said = {*_WORD.findall(last), *_WORD.findall(in_english(last))}
    words = {*_WORD.findall(name.lower())}
    long = bool(words) and all(len(word) > 1 for word in words)
    return long and words <= said and not (said - words) & _RATES


def _by_name(log: LogReport, name: str, units: Mapping[str, str]) -> list[_Candidate]:
    """Return the candidates for an input, best first, by its names and those of its unit."""
    meanings = (*_MEANINGS.get(name, (name,)), *NAMES_BY_UNIT.get(units.get(name, ""), ()))
    return _candidates(log, name, meanings, is_input=True) or _commanded(log, name)


def _sent(candidates: Sequence[_Candidate]) -> str:
    """Return the best number for an input if its name says that it is a command; else "".

    That is no measurement: in a log of poses and /cmd_vel the commands were taken for the measured
    speed and turn rate.
    """
    best = next(iter(candidates), None)
    if best is None or best.score < LEAST:
        return ""
    commanded = {*_COMMANDED}.intersection(_WORD.findall(best.field.path))
    return best.field.path if commanded else ""


def _commanded(log: LogReport, name: str) -> list[_Candidate]:
    """Return the candidates for the command of a state, such as roll_command: its own names."""
    state = without_role(name)
    if state == name:
        return []
    found = _candidates(log, state, _MEANINGS.get(state, (state,)), is_input=True)
    return [c for c in found if COMMAND_TOPIC.search(c.topic.topic.lower())]


def _of_unit(log: LogReport, candidates: list[_Candidate], unit: str) -> list[_Candidate]:
    """Drop a state's candidates in another unit, if one that fits is left.

    If all candidates by name have another unit, every changing number in the right unit becomes a
    candidate; if there is none, those of another unit that change.
    """
    fit = [c for c in candidates if _may_be(c.field.path, unit)]
    good = [c for c in candidates if c.score >= LEAST]
    if not good or any(c.score >= LEAST for c in fit):
        return fit if good else candidates
    moving = [
        _Candidate(LEAST, topic, field)
        for topic in log.topics
        if not COMMAND_TOPIC.search(topic.topic.lower())
        for field in topic.fields
        if field.low != field.high and unit_of(field.path) == unit
    ]
    return moving or [c for c in candidates if c.field.low is None or c.field.low != c.field.high]


def _of_stem(log: LogReport, name: str, unit: str) -> list[_Candidate]:
    """Return the number that a state's name begins with in the state's kind of unit.

    So `wheel_rpm` is the state wheel_speed [rad/s]. Empty if it is none or several.
    """
    stem = re.sub(r"_(rate|speed|velocity|vel|omega|dot)$", "", name.lower())
    if stem == name.lower() or unit in ("", "1"):  # motor_pct may be a command
        return []
    found = [
        _Candidate(LEAST + 1.0, topic, field)
        for topic in log.topics
        for field in topic.fields
        if field.low != field.high
        and re.split(r"[/.]", without_unit(field.path).lower())[-1].strip('"') == stem
        and factor_between(unit_in_name(field.path), unit) is not None
    ]
    return found if len(found) == 1 else []


def _may_be(path: str, unit: str) -> bool:
    """Check that a number's unit does not contradict; a joint's may be either, see `in_order`."""
    return path.endswith("]") or may_be(path, unit)


def _only_command(log: LogReport, guess: Guess, unit: str) -> Guess:
    """Assign a single input without a matching name to the only command that changes.

    The guess is unchanged if several commanded numbers change.
    """
    if guess.path or not guess.reasons or len(guess.others) != 1:
        return guess
    path = guess.others[0]
    if not _may_be(path, unit):
        return guess
    why = "no name matches; the only command in the log that changes"
    return taking(replace(guess, others=()), path, log, why)


def commands_of(log: LogReport, guess: Guess, taken: set[str]) -> Guess:
    """Give an input without a matching name the changing numbers of command topics."""
    others = _moving_commands(log, taken)
    why = ("no name matches; these are commands",) if others else ()
    return replace(guess, others=others[:8], reasons=why)


def _moving_commands(log: LogReport, taken: set[str]) -> tuple[str, ...]:
    """Return the changing numbers of command topics, without those that are taken."""
    commands = [t for t in log.topics if COMMAND_TOPIC.search(t.topic.lower())]
    moving = [f.path for t in commands for f in t.fields if f.low != f.high]
    return tuple(path for path in moving if path not in taken and not path.endswith(_QUATERNION))


def _meanings(log: LogReport, name: str, states: Sequence[str]) -> tuple[str, ...]:
    """Return the usual names of a state; north and east only if the log has both."""
    if name == "v" and "u" in states:
        return _BESIDE_U
    said = {without_unit(f.path).lower().rpartition(".")[2] for f in log.numbers}
    plane = all(said.intersection(axis) for axis in _COMPASS)
    left = () if plane else {one for axis in _COMPASS for one in axis}
    return tuple(one for one in _MEANINGS.get(name, (name,)) if one not in left)


def _candidates(
    log: LogReport, name: str, meanings: Sequence[str], *, is_input: bool
) -> list[_Candidate]:
    found, called = [], (name.lower(), *meanings)
    for topic in log.topics:
        for field in topic.fields:
            score = _score(called, topic, field, is_input=is_input)
            if score > 0:
                found.append(_Candidate(score, topic, field))
    return sorted(found, key=lambda c: -c.score)


def _score(
    called: Sequence[str], topic: TopicReport, field: FieldReport, *, is_input: bool
) -> float:
    path = field.path.lower()
    inside = field.path[len(topic.topic) :].lower().strip('".')
    plain = bare_command if is_input else without_unit
    bare = plain(field.path)[len(topic.topic) :].lower().strip('".')
    apart = _HUMP.sub("_", field.path[len(topic.topic) :]).lower().strip('".')
    ways = {inside, bare, apart, in_english(inside), in_english(bare), _FLAT.sub(r".\1.", inside)}
    best = max(_fit(called, one, topic.topic.lower()) for one in ways)
    folders = topic.topic.lower().split("/")[:-1]  # /thrusters/left/command is the input `left`
    if is_input and inside in ("data", "value") and set(called) & set(folders):
        best = max(best, 3.0)
    if best <= 0 or (is_input and topic.type.endswith(MEASURED)):
        return 0.0
    words = {*_WORD.findall(path), *_WORD.findall(in_english(inside))}
    commanded = any(word in words for word in _COMMANDED)
    best += (0.5 if is_input else -2.0) * commanded
    best -= 3.0 if field.low is None else 0.0
    best -= 1.0 if field.low == field.high else 0.0
    best -= 1.0 if topic.messages < 3 else 0.0
    best -= 2.0 if field.not_finite > 0.1 * topic.messages else 0.0
    best -= 2.0 if "covariance" in path or "layout" in path else 0.0
    best -= 3.0 if inside.endswith(_QUATERNION) else 0.0  # useless alone
    best += 0.5 if topic.stamped and not is_input else 0.0
    return best


def _fit(called: Sequence[str], inside: str, topic: str) -> float:
    """Score how well a name fits: by the end of the path, or by the topic if that is generic."""
    best = 0.0
    for rank, meaning in enumerate(called):
        if WORLD in inside and WORLD not in meaning:
            continue  # its last letter is an axis, not a name
        worth = 4.0 - 0.3 * max(rank - 1, 0)
        if inside == meaning or inside.endswith("." + meaning):
            best = max(best, worth + (0.5 if "." in meaning else 0.0))
        last = re.sub(r"[_\d]+$", "", topic.rsplit("/", 1)[-1])
        if inside in ("data", "value") and last == meaning:
            best = max(best, worth)
        elif len(meaning) > 1:
            words = set(_WORD.findall(_named(inside, last)))
            rate = words & _RATES - set(_WORD.findall(meaning))  # `yaw_rate` is not a yaw
            best = max(best, worth - 1.0) if meaning in words and not rate else best
    return best


def _named(inside: str, last: str) -> str:
    """Return the text whose words name a number: a topic of one number, or a table's column."""
    if inside in ("data", "value"):
        return last
    return "" if "." in inside or "[" in inside or last not in ("npz", "csv", "run") else inside


def _homes(scored: dict[str, list[_Candidate]]) -> dict[str, float]:
    """Return a bonus for each topic by the number of states it could provide.

    States from one message are preferred to scattered ones.
    """
    homes: dict[str, float] = {}
    for candidates in scored.values():
        for topic in {c.topic.topic for c in candidates if c.score >= LEAST}:
            homes[topic] = homes.get(topic, 0.0) + 0.75
    return homes


def _choose(
    log: LogReport, name: str, candidates: list[_Candidate], homes: dict[str, float]
) -> Guess:
    ranked = sorted(candidates, key=lambda c: -(c.score + homes.get(c.topic.topic, 0.0) + _rate(c)))
    ranked = [c for c in ranked if c.score >= LEAST]
    if not ranked:
        return Guess(name, "", "", False, tuple(c.field.path for c in candidates[:3]))
    still, best = ranked[0], _moving(ranked)
    if best is not still:
        why = f"{still.field.path} never changes in this log"
        rest = tuple(c.field.path for c in ranked if c is not best)[:3]
        return Guess(
            name, best.field.path, clock_of(log, best.topic), False, rest, best.field, (why,)
        )
    value = best.score + homes.get(best.topic.topic, 0.0)
    near = [c for c in ranked[1:] if c.score + homes.get(c.topic.topic, 0.0) > value - SURE]
    reasons: tuple[str, ...] = ()
    if (measured := _measured(best, ranked)) is not None:
        reasons = (
            f"measured independently of the wheels; the pose of {best.topic.topic} is most likely "
            "integrated from its own speed, so it adds no information",
        )
        best, near = measured, [best, *(c for c in near if c is not measured)]
    others = tuple(c.field.path for c in near[:3])
    clock = clock_of(log, best.topic)
    return Guess(name, best.field.path, clock, not near, others, best.field, reasons)


def _moving(ranked: list[_Candidate]) -> _Candidate:
    """Return the best candidate; if it never changes, the best of its name or kind that does."""
    best = ranked[0]
    if best.field.low is None or best.field.low != best.field.high:
        return best
    moves = (c for c in ranked if c.field.low is not None and c.field.low != c.field.high)
    return next((c for c in moves if _alike(c.field.path, best.field.path)), best)


def _alike(path: str, other: str) -> bool:
    """Check whether two numbers have the same name in their messages, or units that may agree."""
    return path.split(".")[-2:] == other.split(".")[-2:] or unit_of(path) in ("", unit_of(other))


def taking(guess: Guess, path: str, log: LogReport, why: str) -> Guess:
    """Return a guess that takes a number of the log, by its topic's clock, for a reason."""
    topic, field = next((t, f) for t in log.topics for f in t.fields if f.path == path)
    return replace(guess, path=path, field=field, clock=clock_of(log, topic), reasons=(why,))


def clock_of(log: LogReport, topic: TopicReport) -> str:
    """Return the clock by which a topic's numbers are read."""
    return "header" if topic.stamped and not is_simulated(log) else "log"


def _measured(best: _Candidate, ranked: list[_Candidate]) -> _Candidate | None:
    """Return a candidate that measures the position or heading given by wheel odometry."""
    kind = next((one for one in _POSE if best.field.path.endswith(one)), None)
    if kind is None or not _reckons(best.topic):
        return None
    often = AS_OFTEN * best.topic.rate_hz  # a pose updated twice a second shows no motion
    poses = (c for c in ranked if c.topic.type.endswith(POSES) and c.topic.rate_hz >= often)
    fits = (c for c in poses if c.field.path.endswith(kind) and c.score > best.score - SURE)
    return next(fits, None)


def _reckons(topic: TopicReport) -> bool:
    """Check whether a topic's pose is most likely integrated from its own speed."""
    moves = any(f.path.endswith("twist.linear.x") and f.low != f.high for f in topic.fields)
    return topic.type.endswith("/Odometry") and moves and not _NO_WHEELS.search(topic.topic.lower())


def _rate(candidate: _Candidate) -> float:
    """Return a small bonus for a high rate, which breaks ties."""
    return 0.1 * float(np.log10(1 + candidate.topic.rate_hz))


def is_simulated(log: LogReport) -> bool:
    """Check whether header stamps are on another clock than the log, as in a simulation."""
    return any(t.skew_s is not None and abs(t.skew_s) > SIMULATED_S for t in log.topics)
