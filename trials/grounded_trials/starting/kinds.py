"""Guesses the kind of robot from a log, and writes its model skeleton with the log's names.

A skeleton is a model.py that runs unchanged: the simplest equations of its kind of robot, with wide
bounds on the parameters. Users are expected to edit it.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence

from grounded.checks import refused, unknown
from grounded.findings import found as found_
from grounded.units import factor_between
from grounded_trials.logs.inspection.guess import Guess
from grounded_trials.logs.inspection.inspect_log import FieldReport, LogReport, TopicReport
from grounded_trials.logs.inspection.joint_names import at_joints, from_base, slides
from grounded_trials.logs.inspection.names import NAMES_BY_UNIT, PARTS, POSES
from grounded_trials.logs.inspection.relations import Signals
from grounded_trials.logs.stated_units import Stated, bare_command, command_unit, unit_in_name
from grounded_trials.starting.pushed import pushed, pushed_by
from grounded_trials.starting.skeletons import Skeleton, arm, driven_by, drone, fixed
from grounded_trials.workspace.user_files.model_file import PLACEHOLDER

Joints = Mapping[str, tuple[str, ...]]  # joint names by topic, see `joint_names`
Units = Mapping[str, str]  # unit of a number by its path
HELD = 0.3  # share of samples equal to the previous one, above which a number is a command
QUIET = 10.0  # range of a number of noise alone, in standard deviations of that, at most
MOST_STATES, MOST_INPUTS = 6, 4  # largest number of states and of guessed inputs of a generic model
SIDES = re.compile(r"^(left|right|u\d*|u_\w+)$")  # names of inputs, in addition to COMMANDED
COMMANDED = re.compile(
    "cmd|command|desired|setpoint|target|input|throttle|torque|tau|effort|volt|pwm|duty|motor|steer"
    "|rudder|aileron|elevator|thruster"
    r"|goal|control|\baction\b|\.reference\.|\.output\.|_con|_ref|stellgr|stellwert|sollwert|_soll\b|befehl|consigne|commande"
    "|comando"
)
SURGE = "u", {"x", "y", "psi", "r"}  # a name of an input, but beside these the speed ahead
DONE = re.compile(r"\.(feedback|actual)\.")  # what a controller's joints did
ACTUATOR = re.compile("servo|actuator")  # either a command or a measured position
EFFORT = re.compile("force|thrust|power")  # an input if nothing else looks like one
EFFORT_UNITS = NAMES_BY_UNIT.keys() - {"A"}  # a current in a log is mostly a measured one

HEADING = re.compile(r"(^|[/._])(yaw|psi|heading|theta|th|orientation)([/._\d]|$)")
SENSED = re.compile(
    "encoder|tick|position|current|effort|bumper|cliff|range|sonar|feedback|measured"
)
OTHER = {"left": "right", "Left": "Right", "LEFT": "RIGHT"}
PITCHES, ROLLS_ON = {"pitch", "tilt", "lean"}, {"x", "v", "position", "speed", "velocity", "wheel"}
FLIES = {"roll", "yaw", "z", "thrust", "altitude", "elevator", "rudder", "steering", "psi"}
SWINGS = re.compile(r"angle|swing|sway|pendulum|pole|theta|tilt")  # angle of a load on a trolley
SPEEDS = ("v", "vel", "speed", "velocity", "linear", "lin_vel", "v_x", "vx")
TURNS = ("w", "omega", "turn", "turn_rate", "yaw_rate", "angular", "ang_vel", "wz", "r")
AFLOAT = re.compile(r"thruster|propeller|(^|[/._])(usv|wamv|boat|vessel)([/._\d]|$)")
FLYING = re.compile(
    r"(^|[/_])(cf\d*|crazyflie|quad(rotor|copter)?|drone|uav|mavros|copter)([/_]|$)"
)


def moving(log: LogReport) -> dict[str, FieldReport]:
    """Return the numbers of a log that change, by their names in a generic model.

    Of several with one name, such as the x of a position and of a speed, the others are named after
    their group, too: linear_x. What an IMU measures comes after all others, and its accelerations
    are never named x, y, z.
    """
    topics = sorted(log.topics, key=lambda t: t.type.endswith("/Imu"))
    fields = [one for t in topics for one in t.fields if one.low != one.high]
    fields = [one for one in fields if not PARTS.search(one.path)]
    found: dict[str, FieldReport] = {}
    for one in fields:
        name, grouped = _word(one.path), _in_group(one.path)
        name = grouped if grouped.startswith(("angular_", "linear_acceleration_")) else name
        if name not in found:
            found[name] = one
        elif not (one.path.count("@") or grouped in found):
            found[grouped] = one
    return dict(reversed(found.items()))


def _noise_only(field: FieldReport) -> bool:
    """Return whether a number never moves beyond its noise, as the roll rate of a car does."""
    if field.low is None or field.high is None:
        return False
    return field.high - field.low < QUIET * field.noise


def called_input(name: str, path: str, beside: Collection[str]) -> bool:
    """Return whether more in a number's name, beside all names, speaks for a command than not."""
    speaks_for = bool(COMMANDED.search(path.lower())) + bool(SIDES.search(name))
    surge = name == SURGE[0] and {*beside} >= SURGE[1]
    return speaks_for > surge + 2 * bool(DONE.search(path))


def generic(log: LogReport, inputs: Sequence[str] = (), units: Units | None = None) -> Skeleton:
    """Return a skeleton for any robot, with the numbers of the log as states and inputs.

    A state whose rate is another state gets that as its derivative; every other state follows the
    inputs with a first-order lag, its own command alone if each input is the command of a state.
    Numbers of noise alone are no states. Without `inputs`, the inputs are the numbers that are
    named like commands, else those held constant over several samples while others move, else
    those named after an actuator, else forces, torques and voltages.

    Args:
        log: the log.
        inputs: names of the numbers that are inputs, in order; empty: guessed as above.
        units: units by path, where the log states them.

    Raises:
        GroundedError: for an input that the log does not have.
    """
    found, known = moving(log), units or {}
    unit = {n: known.get(f.path) or unit_in_name(f.path) or "1" for n, f in found.items()}
    for name in (one for one in inputs if one not in found):
        if any(_word(one.path) == name for one in log.numbers):
            raise refused("start.still", name)
        raise unknown("number", name, found, "the log")
    called = [n for n in reversed(found) if called_input(n, found[n].path, found)]
    followers = _followers(found, list(inputs) or called)
    inputs = inputs or list(followers.values())[:MOST_STATES] or _inputs_in(found, called, unit)

    # The states, and those whose rate is another one.
    named = [name for name in reversed(found) if name not in inputs]
    moved = [name for name in named if not _noise_only(found[name])]
    states = (moved or named)[:MOST_STATES] or ["x"]
    rates = _rates(log, {name: found[name].path for name in states if name in found})
    for position, rate in rates.items():  # v is logged without a unit, x in m: v is in m/s
        known_as = rate.removeprefix("s.")
        if unit.get(known_as) == "1" != unit[position]:
            unit[known_as] = f"{unit[position]}/s"

    # The equations of the others: each lags behind its own command, or behind all inputs.
    equations, lags, gains = [], dict[str, str](), dict[str, str]()
    for s in states:
        if s in rates:
            equations.append(f'"{s}": {rates[s]}')
            continue
        own = (
            {followers[s]: f"gain_{s}"} if s in followers else {i: f"gain_{s}_{i}" for i in inputs}
        )
        sums = " + ".join(f"p.{gain} * a.{i}" for i, gain in own.items())
        equations.append(f'"{s}": ({sums} - s.{s}) / p.tau_{s}')
        lags[f"tau_{s}"] = '1.0, "s", 0.01, 100.0'
        for i, gain in own.items():
            per = f"/({unit[i]})" if unit.get(i, "1") != "1" else ""
            gains[gain] = f'{1.0 * (s in followers)}, "{unit.get(s, "1")}{per}", -100.0, 100.0'
    return Skeleton(
        "generic",
        f"Numbers that follow the inputs with a lag: {PLACEHOLDER}",
        {s: unit.get(s, "1") for s in states},
        {i: unit.get(i, "1") for i in inputs},
        lags | gains,
        equations,
        tuple(s for s in states if unit.get(s) == "rad" and _turns(found[s])),
    )


def _inputs_in(
    found: Mapping[str, FieldReport], called: Sequence[str], unit: Mapping[str, str]
) -> list[str]:
    """Return the numbers that look like inputs: by their names, how they are held, their units."""
    names = [*found][::-1]
    held = [n for n in names if found[n].held > HELD]
    held = held if 2 * len(held) < len(names) else []
    driven = [n for n in names if ACTUATOR.search(n.lower())]
    efforts = [n for n in names if EFFORT.search(n.lower()) or unit[n] in EFFORT_UNITS]
    return (list(called) or held or driven or efforts)[:MOST_INPUTS] or ["u"]


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


def _rates(log: LogReport, paths: Mapping[str, str]) -> dict[str, str]:
    """Return for each position, by name, its rate as an expression of another number of the log."""
    names = {path: name for name, path in paths.items()}
    signals = Signals(log, (), Stated.by(log.files))
    return {
        names[position]: f"{times:g} * " * (times != 1) + f"s.{names[rate]}"
        for position, (rate, times) in signals.rates(list(names)).items()
    }


def _in_group(path: str) -> str:
    """Return the end of a message path with the name before it, as a Python name: linear_x."""
    last = re.sub(r"\W+", "_", ".".join(path.rsplit(".", 2)[-2:])).strip("_")
    return last if last.isidentifier() else f"s_{last}"


def _word(path: str) -> str:
    """Return the end of a message path as a Python name."""
    last = path.replace("@", "").rsplit(".", 1)[-1].strip('"')
    name = last if last not in ("data", "value") else path.rsplit(".", 1)[0].rsplit("/", 1)[-1]
    name = re.sub(r"\W+", "_", name).strip("_")
    return name if name.isidentifier() else f"s_{name}"


KINDS = (
    "car",
    "rover",
    "differential",
    "boat",
    "balance",
    "drone",
    "arm",
    "pendulum",
    "crane",
    "generic",
)


def kind_in(log: LogReport, joints: Joints) -> tuple[str, str]:
    """Return the kind of robot that a log was probably recorded on, and the names that show it."""
    steered = next((t.topic for t in log.topics if "Ackermann" in t.type), None)
    if steered is not None:
        return "car", steered
    if hung := _hung(log, joints):
        return "crane", hung
    if joints := _turning(of_arms(at_joints(joints))):
        where, names = next(iter(joints.items()))
        kind = "arm" if len(names) > 1 else "pendulum"
        return kind, f"{where}: {', '.join(names[:6])}"
    flying = next((t.topic for t in log.topics if FLYING.search(t.topic.lower())), None)
    if flying is not None:
        return "drone", flying
    both = _both_sides(log)
    afloat = [t for t in log.topics if AFLOAT.search(t.topic.lower())]
    pairs = both or next(filter(None, map(_two_unnamed, afloat)), ())
    if afloat and pairs and (both or _headed(log)):
        return "boat", ", ".join((afloat[0].topic, *pairs))
    for wanted, kind in (
        (("steer",), "car"),
        (("thrust(?!er)", "attitude_setpoint", "actuator_outputs"), "drone"),
        (("cmd_vel",), "rover"),
    ):
        for topic in log.topics:
            if _says(topic, wanted):
                return kind, topic.topic
    words = {_word(one.path).lower() for one in log.numbers}
    if both:
        return "differential", ", ".join(both)
    if sent := _speed_and_turn(log):
        return "rover", ", ".join(sent)
    if command := _balancing(log):
        return "balance", command
    if words & {"theta", "angle", "q", "q_rad", "position"} and words & {"torque", "tau", "u"}:
        return "pendulum", ", ".join(sorted(words))
    if flat := next((t.topic for t in log.topics if _in_the_plane(t)), None):
        return "rover", flat
    return "generic", "--kind names another"


def of_arms(joints: Joints) -> Joints:
    """Return the topics whose joints are not all wheels."""
    return {
        topic: names
        for topic, names in joints.items()
        if not all("wheel" in name.lower() for name in names)
    }


def _turning(joints: Joints) -> Joints:
    """Return the topics whose joints do not all slide: slides alone form no arm or pendulum."""
    return {topic: names for topic, names in joints.items() if not all(map(slides, names))}


def _hung(log: LogReport, joints: Joints) -> str:
    """Return the evidence that a load or pole swings on a trolley, "" if there is none."""
    own = [(topic, names) for topic, names in joints.items() if sum(map(slides, names)) == 1]
    driving = ("/Odometry", "/Twist", "/TwistStamped")
    if not own or any(t.type.endswith(driving) for t in log.topics):
        return ""
    (topic, names), found = own[0], moving(log)
    slide, others = next(filter(slides, names)), [name for name in names if not slides(name)]
    if len(others) == 1:
        return f"{topic}: {slide}, {others[0]}"
    angles = [
        n for n, one in found.items() if SWINGS.search(n) and not called_input(n, one.path, found)
    ]
    if others or not angles:
        return ""
    return f"{topic}: {slide}, {found[angles[0]].path}"


def _crane(log: LogReport, units: Units) -> Skeleton:
    """Return the crane skeleton with the log's command; unless it is a force, in V or unitless."""
    sent, plain = sent_in(log), fixed("crane")
    if len(sent) != 1 or {*sent} <= {*plain.inputs}:
        return plain
    ((name, path),) = sent.items()
    unit = "V" if command_unit(name, path, units).endswith("V") else "1"
    gain = plain.params["gain"].replace("m/s^2/N", "m/s^2" + "/V" * (unit == "V"))
    return driven_by(plain, {"force": (name, unit)}, gain=gain)


def _headed(log: LogReport) -> bool:
    """Return whether a log has a heading that changes."""
    return any(HEADING.search(path.lower()) for path in log.moving)


def _two_unnamed(topic: TopicReport) -> tuple[str, ...]:
    """Return the two changing numbers of a topic that is an unnamed array; else ()."""
    found = tuple(f.path for f in topic.fields if f.low != f.high)
    return found if len(found) == 2 and all(f.endswith("]") for f in found) else ()


def _both_sides(log: LogReport) -> tuple[str, ...]:
    """Return the names of a left and a right command; () without both, or without a heading."""
    paths = {*log.moving}
    if not _headed(log):
        return ()
    for left in sorted(paths):
        right = re.sub("left|Left|LEFT", lambda m: OTHER[m[0]], left)
        if right == left or right not in paths or SENSED.search(left.lower()):
            continue
        names = _word(left), _word(right)
        if names[0] != names[1]:
            return names
        if COMMANDED.search(left.lower()) or EFFORT.search(left.lower()):  # /left/thrust
            return "left", "right"
    return ()


def _speed_and_turn(log: LogReport) -> tuple[str, ...]:
    """Return the names of a speed command and of a turn rate command; () without a heading."""
    sent = {bare_command(path).rpartition(".")[2].lower(): n for n, path in sent_in(log).items()}
    pairs = [(sent.get(v, ""), sent.get(w, "")) for v in SPEEDS for w in TURNS]
    return next((pair for pair in pairs if all(pair)), ()) if _headed(log) else ()


def _balancing(log: LogReport) -> str:
    """Return the command of a robot balancing on two wheels, "" if the log is of another kind."""
    found = moving(log)
    words = {word for name in found for word in (name.lower(), *name.lower().split("_"))}
    if not words & PITCHES or not words & ROLLS_ON or words & FLIES:
        return ""
    sent = [*sent_in(log)]
    return sent[0] if len(sent) == 1 else ""


def encoders(log: LogReport, joints: Joints) -> str:
    """Return the JointState topic whose joints are all wheels, "" if positions come with it."""
    driven = any(
        one.path.endswith(("position.x", "twist.linear.x")) and one.low != one.high
        for topic in log.topics
        if topic.type.endswith(("/Odometry", *POSES))
        for one in topic.fields
    )
    wheels = set(joints) - set(of_arms(joints))
    moves = {*log.moving}
    turned = [topic for topic in joints if topic in wheels and f"{topic}.position[0]" in moves]
    return "" if driven or not turned else turned[0]


def by_encoders(
    states: Sequence[Guess], log: LogReport, joints: Joints, r: float
) -> Sequence[Guess]:
    """Give x and v of a balancing robot the first wheel's angle and speed, times a radius r [m]."""
    if not (where := encoders(log, joints)):
        return states
    moving = {*log.moving}
    wheel, ends, found = joints[where][0], {"x": "position", "v": "velocity"}, []
    for guess in states:
        path = f"{where}.{ends.get(guess.name, '')}[0]"
        if path in moving and guess.name in ends:
            why, clock = found_("start.encoder", path, joint=wheel), log.clock(log.topic_of(path))
            guess = Guess(guess.name, path, clock, False, (), log.number(path), (why,), r)
        found.append(guess)
    return found


def _drone(log: LogReport) -> Skeleton:
    """Return the drone's skeleton: its yaw is a constant if the log's hardly changes."""
    yaws = [(t, f) for t in log.topics for f in t.fields if f.path.endswith("@rpy.yaw")]
    commands = [t for t in log.topics if COMMANDED.search(t.topic.lower())]
    own = next((f for t, f in yaws if t not in commands), None)
    sent = any(t in commands and f.low != f.high for t, f in yaws)
    rates = any(_says(t, (r"angular\.z",)) for t in commands)
    command = "yaw_command" if sent else "yaw_rate" if rates else ""
    low, high = (own.low or 0.0, own.high or 0.0) if own else (0.0, 0.0)
    return drone(low, high, command)


def _in_the_plane(topic: TopicReport) -> bool:
    """Return whether a topic is odometry of a robot that moves neither up nor sideways."""
    still = ("position.z", "linear.y", "linear.z")
    fields = [one for one in topic.fields if one.path.endswith(still)]
    odometry = topic.type.endswith("/Odometry") and topic.messages > 2
    return odometry and len(fields) == 3 and all(one.low == one.high for one in fields)


def _says(topic: TopicReport, words: Sequence[str]) -> bool:
    everything = " ".join([topic.topic, *(one.path for one in topic.fields)]).lower()
    return any(re.search(word, everything) for word in words)


def _car(log: LogReport, units: Units) -> Skeleton:
    """Return the car skeleton: driven by the log's own command, steered in rad or unitless."""
    numbers = [one.path for one in log.numbers]
    said = {unit_in_name(path) for path in numbers if "steer" in _word(path).lower()} - {""}
    angle = any(factor_between(unit, "rad") is not None for unit in said)
    part = any(factor_between(unit, "1") is not None for unit in said)
    throttle = any(_says(topic, ("throttle",)) for topic in log.topics)
    unit = "rad" if angle or not (throttle or part) else "1"
    plain = driven_by(fixed("car"), {"steering": ("steering", unit)})
    return pushed_by(plain, "throttle", "1") if throttle else pushed(plain, sent_in(log), units)


def sent_in(log: LogReport) -> dict[str, str]:
    """Return the paths of the numbers that are named like commands, by their names."""
    found = moving(log)
    return {n: one.path for n, one in found.items() if called_input(n, one.path, found)}


def skeleton(
    kind: str,
    log: LogReport,
    joints: Joints,
    inputs: Sequence[str] = (),
    units: Units | None = None,
) -> Skeleton:
    """Return the skeleton of a kind with the log's names; for the arguments see `generic`."""
    if kind == "arm":
        joints = of_arms(joints) or joints
        return arm(from_base(next(iter(joints.values()))) if joints else ("joint1", "joint2"))
    ackermann = any("Ackermann" in topic.type for topic in log.topics)
    if kind == "car" and not ackermann:
        return _car(log, units or {})
    if kind == "rover":
        return pushed(fixed(kind), sent_in(log), units or {})
    if kind in ("differential", "boat"):
        plain, both = fixed(kind), _both_sides(log)
        return driven_by(plain, {old: (n, "1") for old, n in zip(plain.inputs, both, strict=False)})
    if kind == "crane":
        return _crane(log, units or {})
    if kind == "balance" and (command := _balancing(log)):
        plain = fixed("balance_by_encoders" if encoders(log, joints) else kind)
        if command_unit(command, sent_in(log)[command], units or {}).endswith("V"):
            return driven_by(plain, {"voltage": (command, "V")})
        unitless = {"kt": '0.5, "N m", 0.0001, 50.0', "ke": '0.03, "s/rad", 0.0, 5.0'}
        return driven_by(plain, {"voltage": (command, "1")}, **unitless)
    if kind == "drone":
        return _drone(log)
    return generic(log, inputs, units) if kind == "generic" else fixed(kind)
