"""Guesses the kind of robot from a log, and writes its model skeleton with the log's names.

A skeleton is a model.py that runs unchanged: the simplest equations of its kind of robot, with wide
bounds on the parameters. Users are expected to edit it.

The skeletons of a car and a rover are driven by a desired speed. Where a log has none, but one
command of a motor (a duty, a throttle, a voltage), that is the input, under its own name and in its
own unit (`pushed`), and `gain` is the speed per unit of it that the log shows (`with_gain`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from grounded.checks import refused, unknown
from grounded.units import factor_between
from grounded_trials.logs.inspection.guess import Guess
from grounded_trials.logs.inspection.inspect_log import FieldReport, LogReport
from grounded_trials.logs.inspection.joint_names import from_base, joint_names, part_of, slides
from grounded_trials.logs.inspection.names import PARTS
from grounded_trials.logs.inspection.relations import Signals
from grounded_trials.logs.stated_units import bare_command
from grounded_trials.starting.skeletons import Skeleton, arm, driven_by, drone, fixed

HELD = 0.3  # share of samples equal to the previous one, above which a number is a command
MOST_STATES, MOST_INPUTS = 6, 4  # largest number of states and of guessed inputs of a generic model
SIDES = re.compile(r"^(left|right|u\d*|u_\w+)$")  # names of inputs, in addition to COMMANDED
COMMANDED = re.compile(
    "cmd|command|desired|setpoint|target|input|throttle|torque|tau|effort|volt|pwm|duty|motor|steer"
    "|rudder|aileron|elevator|thruster"
    r"|goal|control|\baction\b|\.reference\.|\.output\.|_con|_ref"
)
SURGE = "u", {"x", "y", "psi", "r"}  # a name of an input, but beside these the speed ahead

HEADING = re.compile(r"(^|[/._])(yaw|psi|heading|theta|th|orientation)([/._\d]|$)")
OTHER = {"left": "right", "Left": "Right", "LEFT": "RIGHT"}
AFLOAT = re.compile(r"thruster|propeller|(^|[/._])(usv|wamv|boat|vessel)([/._\d]|$)")
FLYING = re.compile(
    r"(^|[/_])(cf\d*|crazyflie|quad(rotor|copter)?|drone|uav|mavros|copter)([/_]|$)"
)
SPEED = re.compile(r"speed|veloc|(^|[/._])vel([/._]|$)|cmd_vel|linear")
MOTOR = re.compile("throttle|duty|pwm|motor|volt|current|power|effort|torque|(^|[/._])(gas|esc)")
GAIN_RANGE = 5.0  # the gain's bounds are that many times smaller and larger


def moving(log: LogReport) -> dict[str, FieldReport]:
    """Return the numbers of a log that change, by their names in a generic model.

    Of several with one name, such as the x of a position and of a speed, the others are named after
    their group, too: linear_x.
    """
    found: dict[str, FieldReport] = {}
    for one in log.numbers:
        if one.low != one.high and not PARTS.search(one.path):
            name = _word(one.path)
            found.setdefault(_in_group(one.path) if name in found else name, one)
    return found


def generic(clues: Clues, inputs: Sequence[str] = ()) -> Skeleton:
    """Return a skeleton for any robot, with the numbers of the log as states and inputs.

    A state whose rate is another state gets that as its derivative; every other state follows the
    inputs with a first-order lag, its own command alone if each input is the command of a state.
    Without `inputs`, the inputs are the numbers that are named like commands, else those held
    constant over several samples while others move.

    Raises:
        GroundedError: for an input that the log does not have.
    """
    log, found, called = clues.log, clues.found, [*clues.sent]
    unit = {n: log.unit(f.path) or "1" for n, f in found.items()}
    for name in (one for one in inputs if one not in found):
        if any(_word(one.path) == name for one in log.numbers):
            raise refused("start.still", name)
        raise unknown("number", name, found, "the log")

    # The inputs: as given, the commands of states, what is named like a command, what is held.
    followers = _followers(found, list(inputs) or called)
    held = [name for name, one in found.items() if one.held > HELD]
    held = held if 2 * len(held) < len(found) else []
    guessed = list(followers.values())[:MOST_STATES] or (called or held)[:MOST_INPUTS]
    inputs = inputs or guessed or ["u"]

    # The states, and those whose rate is another one.
    states = [name for name in found if name not in inputs][:MOST_STATES] or ["x"]
    names = {found[name].path: name for name in states if name in found}
    rates = {
        names[position]: f"{times:g} * " * (times != 1) + f"s.{names[rate]}"
        for position, (rate, times) in Signals(log).rates(list(names)).items()
    }

    # The equations of the others: each lags behind its own command, or behind all inputs.
    equations, lags, gains = [], dict[str, str](), dict[str, str]()
    for s in states:
        if s in rates:
            equations.append(f'"{s}": {rates[s]}')
            continue
        own = {i: f"gain_{s}_{i}" for i in inputs}
        own = {followers[s]: f"gain_{s}"} if s in followers else own
        sums = " + ".join(f"p.{gain} * a.{i}" for i, gain in own.items())
        equations.append(f'"{s}": ({sums} - s.{s}) / p.tau_{s}')
        lags[f"tau_{s}"] = '1.0, "s", 0.01, 100.0'
        for i, gain in own.items():
            per = f"/({unit[i]})" if unit.get(i, "1") != "1" else ""
            gains[gain] = f'{1.0 * (s in followers)}, "{unit.get(s, "1")}{per}", -100.0, 100.0'
    return Skeleton(
        "generic",
        "Numbers that follow the inputs with a lag: replace them by your robot's equations",
        {s: unit.get(s, "1") for s in states},
        {i: unit.get(i, "1") for i in inputs},
        lags | gains,
        equations,
        tuple(s for s in states if unit.get(s) == "rad" and _turns(found[s])),
    )


def _turns(number: FieldReport) -> bool:
    """Return whether an angle goes nearly all the way round, to either side."""
    return min(-(number.low or 0.0), number.high or 0.0) > 3.0


def _followers(found: Mapping[str, FieldReport], inputs: Sequence[str]) -> dict[str, str]:
    """Return each state's command by its name, `/action.elbow` for elbow, `v_cmd` for v.

    {} unless each input is the command of one state.
    """
    own = {name: _word(bare_command(found[name].path)) for name in inputs if name in found}
    states = {_word(one.path): name for name, one in found.items() if name not in own}
    followed = {states[state]: name for name, state in own.items() if state in states}
    return followed if len(followed) == len(inputs) else {}


def _in_group(path: str) -> str:
    """Return the end of a message path with the name before it, as a Python name: linear_x."""
    return _python(".".join(path.rsplit(".", 2)[-2:]))


def _word(path: str) -> str:
    """Return the end of a message path as a Python name."""
    last = path.replace("@", "").rsplit(".", 1)[-1].strip('"')
    return _python(path.rsplit(".", 1)[0].rsplit("/", 1)[-1] if last in ("data", "value") else last)


def _python(text: str) -> str:
    name = re.sub(r"\W+", "_", text).strip("_")
    return name if name.isidentifier() else f"s_{name}"


class Clues:
    """What in a log shows the kind of robot."""

    def __init__(self, log: LogReport) -> None:
        self.log, self.found, self.joints = log, moving(log), joint_names(log)
        # the paths of the numbers whose names, beside all others, speak for a command
        ahead = SURGE[0] if {*self.found} >= SURGE[1] else ""
        self.sent = {
            name: one.path
            for name, one in self.found.items()
            if bool(COMMANDED.search(one.path.lower())) + bool(SIDES.search(name)) > (name == ahead)
        }
        # the joints that are not all wheels
        self.arms = {
            t: n for t, n in self.joints.items() if not all("wheel" in j.lower() for j in n)
        }

    def topic(self, pattern: str | re.Pattern[str], *, fields: bool = False) -> str:
        """Return the first topic named like that, or with such a field; "" for none."""
        for topic in self.log.topics:
            names = [topic.topic, *(one.path for one in topic.fields if fields)]
            if re.search(pattern, " ".join(names).lower()):
                return topic.topic
        return ""

    @property
    def ackermann(self) -> str:
        """The topic of a car's commands in ROS."""
        return next((t.topic for t in self.log.topics if "Ackermann" in t.type), "")

    def turning(self, several: bool) -> str:
        """Return the joints that turn, several of an arm or the one of a pendulum."""
        arms = {t: n for t, n in self.arms.items() if not (part_of(t) or all(map(slides, n)))}
        where, names = next(iter(arms.items()), ("", ()))
        return f"{where}: {', '.join(names[:6])}" if where and several == (len(names) > 1) else ""

    @property
    def sides(self) -> tuple[str, ...]:
        """The names of a left and a right command; () without both, or without a heading."""
        paths = {*self.log.moving}
        headed = any(HEADING.search(path.lower()) for path in paths)
        for left in sorted(paths) if headed else ():
            right = re.sub("left|Left|LEFT", lambda m: OTHER[m[0]], left)
            if right != left and right in paths and _word(left) != _word(right):
                return _word(left), _word(right)
        return ()

    @property
    def afloat(self) -> str:
        """The topic of a boat, and its two thrusters."""
        topic = self.topic(AFLOAT) if self.sides else ""
        return ", ".join((topic, *self.sides)) if topic else ""

    @property
    def flat(self) -> str:
        """Odometry of a robot that moves neither up nor sideways."""
        still = ("position.z", "linear.y", "linear.z")
        for topic in self.log.topics:
            fields = [one for one in topic.fields if one.path.endswith(still)]
            odometry = topic.type.endswith("/Odometry") and topic.messages > 2
            if odometry and len(fields) == 3 and all(one.low == one.high for one in fields):
                return topic.topic
        return ""


EVIDENCE: tuple[tuple[str, Callable[[Clues], str]], ...] = (  # the first that a log has decides
    ("car", lambda clues: clues.ackermann),
    ("arm", lambda clues: clues.turning(several=True)),
    ("pendulum", lambda clues: clues.turning(several=False)),
    ("drone", lambda clues: clues.topic(FLYING)),
    ("boat", lambda clues: clues.afloat),
    ("car", lambda clues: clues.topic("steer", fields=True)),
    ("rover", lambda clues: clues.topic("cmd_vel", fields=True)),
    ("differential", lambda clues: ", ".join(clues.sides)),
    ("rover", lambda clues: clues.flat),
    ("generic", lambda clues: "--kind names another"),
)
KINDS = tuple(dict.fromkeys(kind for kind, _ in EVIDENCE))


def kind_in(clues: Clues) -> tuple[str, str]:
    """Return the kind of robot that a log was probably recorded on, and the names that show it."""
    return next((kind, why) for kind, of in EVIDENCE if (why := of(clues)))


def skeleton(kind: str, clues: Clues, inputs: Sequence[str] = ()) -> Skeleton:
    """Return the skeleton of a kind with the log's names; `inputs` are those of a generic one."""
    if kind == "generic":
        return generic(clues, inputs)
    if kind == "arm":
        joints = next(iter((clues.arms or clues.joints).values()), ())
        return arm(from_base(joints) if joints else ("joint1", "joint2"))
    if kind == "drone":
        return _drone(clues)
    plain = fixed(kind)
    if kind == "car" and not clues.ackermann:
        return _car(clues)
    if kind == "rover":
        return pushed(plain, clues)
    if kind in ("differential", "boat"):
        sides = zip(plain.inputs, clues.sides, strict=False)
        return driven_by(plain, {old: (name, "1") for old, name in sides})
    return plain


def _drone(clues: Clues) -> Skeleton:
    """Return the drone's skeleton: its yaw is a constant if the log's hardly changes."""
    topics = clues.log.topics
    commands = [t for t in topics if COMMANDED.search(t.topic.lower())]
    yaws = [(t in commands, f) for t in topics for f in t.fields if f.path.endswith("@rpy.yaw")]
    own = next((f for sent, f in yaws if not sent), None)
    low, high = (own.low or 0.0, own.high or 0.0) if own else (0.0, 0.0)
    rates = any("angular.z" in f.path.lower() for t in commands for f in t.fields)
    command = "yaw_command" if any(sent and f.low != f.high for sent, f in yaws) else ""
    return drone(low, high, command or "yaw_rate" * rates)


def _car(clues: Clues) -> Skeleton:
    """Return the car skeleton, driven by the log's own command, steered by an angle or a lock."""
    steered = (one.path for one in clues.log.numbers if "steer" in _word(one.path).lower())
    said = {clues.log.unit(path) for path in steered} - {""}
    angle, part = (any(factor_between(u, of) is not None for u in said) for of in ("rad", "1"))
    throttle = clues.topic("throttle", fields=True)
    plain = fixed("car" if angle or not (throttle or part) else "car_lock")
    return _pushed_by(plain, "throttle", "1") if throttle else pushed(plain, clues)


def pushed(plain: Skeleton, clues: Clues) -> Skeleton:
    """Return a skeleton driven by the log's only motor command, if that has no speed command."""
    motors = {name: path for name, path in clues.sent.items() if MOTOR.search(path.lower())}
    if len(motors) != 1 or any(SPEED.search(path.lower()) for path in clues.sent.values()):
        return plain
    ((name, path),) = motors.items()
    return _pushed_by(plain, name, clues.log.unit(path) or ("V" if "volt" in name.lower() else "1"))


def _pushed_by(plain: Skeleton, command: str, unit: str) -> Skeleton:
    """Return a skeleton with a command in place of `speed`; for its gain see `with_gain`."""
    per = "m/s" if unit == "1" else f"m/s/({unit})" if " " in unit else f"m/s/{unit}"
    return driven_by(plain, {"speed": (command, unit)}, gain=f'1.0, "{per}", 0.2, 5.0')


def with_gain(plain: Skeleton, found: Mapping[str, Guess], log: LogReport) -> Skeleton:
    """Return such a skeleton with the gain of the log, by least squares; others as given."""
    speed = next((line for line in plain.lines if line.startswith('"v":')), "")
    drive = next((n for n in plain.inputs if f"p.gain * a.{n}" in speed and n != "speed"), "")
    v, u = found.get("v"), found.get(drive)
    gridded = Signals(log).grid((v.path, u.path)) if v and u and v.path and u.path else None
    if gridded is None or v is None or u is None:
        return plain
    moved, sent = v.scale * gridded[1][0], u.scale * gridded[1][1]
    seen = float(moved @ sent) / max(float(sent @ sent), 1e-12)
    unit = plain.params["gain"].split('"')[1]
    if not seen:
        return plain
    low, high = sorted((seen / GAIN_RANGE, seen * GAIN_RANGE))
    gain = f'{seen:.3g}, "{unit}", {low:.2g}, {high:.2g}'
    return replace(plain, params={**plain.params, "gain": gain})
