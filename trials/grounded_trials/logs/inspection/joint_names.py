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

AIMED = {"feedback": ("reference", "output"), "actual": ("desired",)}  # done, and to be done
PLURAL = {"position": "positions", "velocity": "velocities", "effort": "effort"}
LIMB = ("base", "waist", "torso", "shoulder", "upper", "elbow", "fore", "wrist", "hand", "finger")
WITHIN = ("yaw", "pan", "lift", "pitch", "flex", "roll")  # order of joints within one part
SLIDES = {  # words of prismatic joints, in metres
    *("trolley", "cart", "carriage", "slide", "slider", "rail", "prismatic", "linear", "gantry"),
}
TURNS = {*LIMB, *WITHIN, "tilt", "wheel", "hinge", "pole", "pendulum", "swing", "angle", "theta"}
# Points of a joint's number; less of each further one.
NAMED, ORDERED, UNKNOWN, LESS = 6.0, 2.5, 1.5, 0.2


def joint_names(log: LogReport) -> dict[str, tuple[str, ...]]:
    """Return the joints of each topic that names them, in the order of its numbers.

    A topic whose messages name different joints is left out, since its indices are ambiguous.
    """
    there = _there(log)
    parts = {t: [p for p in AIMED if f"{t}.{p}.positions[0]" in there] for t in log.joints}
    return {f"{t}.{parts[t][0]}" if parts[t] else t: names for t, names in log.joints.items()}


def at_joints(joints: Mapping[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
    """Return the topics that hold nothing but what joints do, without those of controllers."""
    return {topic: names for topic, names in joints.items() if _part(topic) not in AIMED}


def number_of(topic: str, kind: str, index: int) -> str:
    """Return the path of a joint's position, velocity or effort."""
    return f"{topic}.{PLURAL[kind] if _part(topic) in AIMED else kind}[{index}]"


def _part(topic: str) -> str:
    return topic.rpartition(".")[2]


def _aimed_at(topic: str, kind: str, index: int, there: set[str]) -> str:
    """Return the path of what a controller commands of a joint, "" if it is not in the log."""
    base, _, part = topic.rpartition(".")
    paths = [f"{base}.{aim}.{PLURAL[kind]}[{index}]" for aim in AIMED[part]]
    return next((path for path in paths if path in there), "")


def slides(joint: str) -> bool:
    """Check whether a joint's name is that of a prismatic joint: a trolley, a rail."""
    return not SLIDES.isdisjoint(_words(joint))


def turns(joint: str) -> bool:
    """Check whether a joint's name is that of a revolute joint."""
    return not TURNS.isdisjoint(_words(joint))


def _words(joint: str) -> list[str]:
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", joint)]


def joint_units(joints: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Return the units of joints' numbers by path: rad for revolute, m for prismatic joints.

    "" for a joint whose name does not show its kind.
    """
    return {
        number_of(topic, kind, i): unit * (slides(joint) or turns(joint))
        for topic, names in joints.items()
        for i, joint in enumerate(names)
        for kind, unit in (SLIDING if slides(joint) else TURNING).items()
    }


def from_base(joints: Sequence[str]) -> tuple[str, ...]:
    """Sort the joints of an arm from its base, by body parts and numbers."""

    def place(joint: str) -> tuple[int, int, list[int]]:
        numbers = [int(n) for n in re.findall(r"\d+", joint)]
        return _first(LIMB, joint), _first(WITHIN, joint), numbers

    return tuple(sorted(joints, key=place))


def _first(words: Sequence[str], joint: str) -> int:
    """Return the index of the first word in a joint's name; `len(words)` if there is none."""
    return next((i for i, word in enumerate(words) if word in joint.lower()), len(words))


@dataclass(frozen=True)
class Joint:
    """A number that belongs to a state or input by the names and the order of joints."""

    points: float
    why: Finding
    doubted: bool = True  # it rests on an order that a person should check


def of_joint(
    name: str, unit: str, joints: Mapping[str, tuple[str, ...]], log: LogReport, *, sent: bool
) -> dict[str, Joint]:
    """Return the numbers of the joint that the name of a state or input contains, by path."""
    for topic, names in joints.items():
        for joint in (joint for joint in names if holds(name, joint)):
            kind = {u: k for k, u in (SLIDING if slides(joint) else TURNING).items()}.get(unit)
            kind = kind or ("position" if unit in ("m", "1") else "")
            why = found("start.joint", topic, joint=joint)
            measured = Joint(NAMED, why, doubted=False)
            plain = unit == "1"  # commands may be torques, positions or speeds
            if kind and (some := _numbers(topic, names, joint, kind, measured, log, sent, plain)):
                return some
    return {}


def in_order(
    roles: Mapping[str, tuple[str, bool]], joints: Mapping[str, tuple[str, ...]], log: LogReport
) -> dict[str, dict[str, Joint]]:
    """Return the numbers of each state and input in order from the base, if none has a name.

    There must be as many of a unit as joints. Prismatic joints have states in m, revolute in rad.

    Args:
        roles: the unit of each state and input without a matching name, and whether it is sent.
        joints: see `joint_names`.
        log: an inspected log.
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
                why = found("start.joint", topic, joint=joint, index=str(_place(joint, names)))
                points = ORDERED if slide or turns(joint) else UNKNOWN
                measured = Joint(points, why, doubted=len(some) > 1)
                given[name] = _numbers(topic, names, joint, kind, measured, log, roles[name][1])
    return given


def _place(joint: str, names: Sequence[str]) -> int:
    return from_base(names).index(joint)


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
    there, path = _there(log), number_of(topic, kind, names.index(joint))
    torque = sent and kind == "effort"
    if sent and _part(topic) in AIMED:
        path = _aimed_at(topic, kind, names.index(joint), there)
    elif arrays := commands(log, len(names)) if torque or (sent and plain) else []:
        at = _place(joint, names)
        paths = [f"{array}[{at}]" for array in arrays] + [path] * (torque and path in there)
        paths += [f"{array}[{k}]" for array in arrays for k in range(len(names)) if k != at]
        why = found("start.joint", arrays[0], joint=joint, index=str(at))
        return {path: Joint(NAMED - LESS * k, why) for k, path in enumerate(paths)}
    elif sent and kind != "effort" and not COMMAND_TOPIC.search(topic.lower()):
        return {}
    return {path: measured} if path in there else {}


def _there(log: LogReport) -> set[str]:
    """Return the paths of a log's numbers."""
    return {one.path for one in log.numbers}


def commands(log: LogReport, count: int) -> list[str]:
    """Return array topics with a command for each of `count` joints."""
    words = ("cmd", "command", "effort", "torque", "desired", "ref")
    return [
        f"{topic.topic}.data"
        for topic in log.topics
        if "MultiArray" in topic.type
        and any(word in topic.topic.lower() for word in words)
        and sum(".data[" in field.path for field in topic.fields) == count
    ]


def holds(name: str, joint: str) -> bool:
    """Check whether a state's name is a joint's, perhaps with a word for the quantity."""
    plain = re.sub(r"(_?joint_?)", "", joint.lower()) or joint.lower()
    return not {joint.lower(), plain}.isdisjoint((name.lower(), *name.lower().split("_")))
