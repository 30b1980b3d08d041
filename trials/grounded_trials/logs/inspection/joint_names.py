"""Assign the numbers of a JointState to joints, and the joints to states of a model.

A JointState names its joints, often in alphabetical order; an array of commands names none.
Models and controllers count from the base. The state of ros2_control's trajectory controller names
its joints, too, and holds what they did beside what they should do: `/state.feedback` and
`/state.reference`, formerly `actual` and `desired`. The former stands for a topic here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from grounded.findings import Finding, found
from grounded_trials.logs.inspection.inspect_log import LogReport
from grounded_trials.logs.inspection.names import COMMAND_TOPIC
from grounded_trials.logs.stated_units import SLIDING, TURNING

Joints = Mapping[str, tuple[str, ...]]  # names by topic, in the order of its numbers
AIMED = {"feedback": ("reference", "output"), "actual": ("desired",)}  # done, and to be done
PLURAL = {"position": "positions", "velocity": "velocities", "effort": "effort"}
LIMB = ("base", "waist", "torso", "shoulder", "upper", "elbow", "fore", "wrist", "hand", "finger")
WITHIN = ("yaw", "pan", "lift", "pitch", "flex", "roll")  # order of joints within one part
SLIDES = {  # words of prismatic joints, in metres
    *("trolley", "cart", "carriage", "slide", "slider", "rail", "prismatic", "linear", "gantry"),
}
TURNS = {*LIMB, *WITHIN, "tilt", "wheel", "hinge", "pole", "pendulum", "swing", "angle", "theta"}
COMMANDS = ("cmd", "command", "effort", "torque", "desired", "ref")  # in topics of arrays
# Points of a joint's number; less of each further one.
NAMED, ORDERED, UNKNOWN, LESS = 6.0, 2.5, 1.5, 0.2


def joint_names(log: LogReport) -> dict[str, tuple[str, ...]]:
    """Return the joints of each topic that names them, in the order of its numbers.

    A topic whose messages name different joints is left out, since its indices are ambiguous.
    """
    parts = {t: [p for p in AIMED if log.number(f"{t}.{p}.positions[0]")] for t in log.joints}
    return {f"{t}.{parts[t][0]}" if parts[t] else t: names for t, names in log.joints.items()}


def part_of(topic: str) -> str:
    """Return which part of a controller's state stands for a topic, "" for another topic."""
    part = topic.rpartition(".")[2]
    return part if part in AIMED else ""


def slides(joint: str) -> bool:
    """Check whether a joint's name is that of a prismatic joint: a trolley, a rail."""
    return _is_of(joint, SLIDES)


def _is_of(joint: str, words: set[str]) -> bool:
    found = re.findall(r"[A-Z]?[a-z]+|[A-Z]+", joint)
    return not words.isdisjoint(word.lower() for word in found)


def joint_units(joints: Joints) -> dict[str, str]:
    """Return the units of joints' numbers by path: rad for revolute, m for prismatic joints.

    "" for a joint whose name does not show its kind.
    """
    return {
        _measured(topic, kind, i): unit * _is_of(joint, SLIDES | TURNS)
        for topic, names in joints.items()
        for i, joint in enumerate(names)
        for kind, unit in _units(joint).items()
    }


def _units(joint: str) -> dict[str, str]:
    return SLIDING if slides(joint) else TURNING


def _measured(topic: str, kind: str, index: int) -> str:
    """Return the path of a joint's position, velocity or effort."""
    return f"{topic}.{PLURAL[kind] if part_of(topic) else kind}[{index}]"


def from_base(joints: Sequence[str]) -> tuple[str, ...]:
    """Sort the joints of an arm from its base, by body parts and numbers."""

    def place(joint: str) -> tuple[int, int, list[int]]:
        limb, within = (
            next((i for i, word in enumerate(words) if word in joint.lower()), len(words))
            for words in (LIMB, WITHIN)
        )
        return limb, within, [int(n) for n in re.findall(r"\d+", joint)]

    return tuple(sorted(joints, key=place))


@dataclass(frozen=True)
class Joint:
    """A number that belongs to a state or input by the names and the order of joints."""

    points: float
    why: Finding
    doubted: bool = True  # it rests on an order that a person should check


def of_joint(
    name: str, unit: str, joints: Joints, log: LogReport, *, sent: bool
) -> dict[str, Joint]:
    """Return the numbers of the joint that the name of a state or input contains, by path."""
    for topic, names in joints.items():
        for joint in (joint for joint in names if _holds(name, joint)):
            kind = {u: k for k, u in _units(joint).items()}.get(unit)
            kind = kind or ("position" if unit in ("m", "1") else "")
            measured = Joint(NAMED, found("start.joint", topic, joint=joint), doubted=False)
            plain = sent and unit == "1"  # commands may be torques, positions or speeds
            if kind and (some := _numbers(topic, names, joint, kind, measured, log, sent, plain)):
                return some
    return {}


def _holds(name: str, joint: str) -> bool:
    """Check whether a state's name is a joint's, perhaps with a word for the quantity."""
    plain = re.sub(r"(_?joint_?)", "", joint.lower()) or joint.lower()
    return not {joint.lower(), plain}.isdisjoint((name.lower(), *name.lower().split("_")))


def in_order(
    roles: Mapping[str, tuple[str, bool]], joints: Joints, log: LogReport
) -> dict[str, dict[str, Joint]]:
    """Return the numbers of each state and input in order from the base, if none has a name.

    There must be as many of a unit as joints. Prismatic joints have states in m, revolute in rad.
    `roles` has the unit of each without a matching name, and whether it is sent.
    """
    if len(joints) != 1:
        return {}
    topic, names = next(iter(joints.items()))
    given: dict[str, dict[str, Joint]] = {}
    for slide, kinds in ((False, TURNING), (True, SLIDING)):
        some = [joint for joint in from_base(names) if slides(joint) is slide]
        for kind, unit in kinds.items():
            those = [name for name, (own, _) in roles.items() if own == unit]
            for name, joint in zip(those, some, strict=True) if len(those) == len(some) else ():
                at = str(from_base(names).index(joint))
                points = ORDERED if _is_of(joint, SLIDES | TURNS) else UNKNOWN
                why = found("start.joint", topic, joint=joint, index=at)
                measured = Joint(points, why, doubted=len(some) > 1)
                given[name] = _numbers(topic, names, joint, kind, measured, log, roles[name][1])
    return given


def _numbers(
    topic: str,
    names: Sequence[str],
    joint: str,
    kind: str,
    measured: Joint,
    log: LogReport,
    sent: bool,
    plain: bool = False,
) -> dict[str, Joint]:
    """Return what is commanded of a joint, or what it does.

    An array with a command for each joint is preferred to measured efforts, which include the
    delay and the limits of the drive; measured positions and velocities are no commands. Of
    several arrays, a joint has the number at its place from the base; the others rival with it.
    """
    index, torque = names.index(joint), sent and kind == "effort"
    path, part = _measured(topic, kind, index), part_of(topic)
    if sent and part:
        aims = (f"{topic.removesuffix(part)}{aim}" for aim in AIMED[part])
        paths = [f"{aim}.{PLURAL[kind]}[{index}]" for aim in aims]
        path = next((path for path in paths if log.number(path)), "")
    elif arrays := _commands(log, len(names)) if torque or plain else []:
        at = from_base(names).index(joint)
        efforts = [path] * (torque and log.number(path) is not None)
        paths = [f"{array}[{at}]" for array in arrays] + efforts
        paths += [f"{array}[{k}]" for array in arrays for k in range(len(names)) if k != at]
        why = found("start.joint", arrays[0], joint=joint, index=str(at))
        return {path: Joint(NAMED - LESS * k, why) for k, path in enumerate(paths)}
    elif sent and not torque and not COMMAND_TOPIC.search(topic.lower()):
        return {}
    return {path: measured} if log.number(path) else {}


def _commands(log: LogReport, count: int) -> list[str]:
    """Return array topics with a command for each of `count` joints."""
    return [
        f"{topic.topic}.data"
        for topic in log.topics
        if "MultiArray" in topic.type
        and any(word in topic.topic.lower() for word in COMMANDS)
        and sum(".data[" in field.path for field in topic.fields) == count
    ]
