"""Assign the numbers of a JointState to joints, and the joints to states of a model.

A JointState names its joints, often in alphabetical order; an array of commands names none.
Models and controllers count from the base.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from grounded_trials.formats.mcap_records import Channel, Messages
from grounded_trials.logs.inspection.inspect_guess import COMMAND_TOPIC, Guess
from grounded_trials.logs.inspection.inspect_log import LogReport
from grounded_trials.logs.log_files import log_records, read_apart
from grounded_trials.logs.stated_units import SLIDING, TURNING

if TYPE_CHECKING:
    from grounded_trials.logs.inspection.inspect_pairs import Signals

LIMB = ("base", "waist", "torso", "shoulder", "upper", "elbow", "fore", "wrist", "hand", "finger")
LEG = ("hip", "thigh", "knee", "shin", "ankle", "foot", "toe")
WITHIN = ("yaw", "pan", "lift", "pitch", "flex", "roll")  # order of joints within one part
SIDES = ("left", "right", "front", "rear")  # words that indicate several limbs
ROLLS = re.compile("wheel|caster|track|rotor|prop|crank|spindle")  # joints that turn endlessly
SLIDES = {  # words of prismatic joints, in metres
    *("trolley", "cart", "carriage", "slide", "slider", "rail", "prismatic", "linear"),
    *("gantry", "lift", "elevator", "telescope"),
}
TURNS = {  # words of revolute joints, which take precedence: a shoulder's lift, a pole on a cart
    *LIMB,
    *LEG,
    *("yaw", "pan", "pitch", "flex", "roll", "tilt", "wheel", "hinge", "revolute", "rotation"),
    *("pole", "pendulum", "swing", "sway", "angle", "theta"),
} - {"base", "torso"}
ALIKE, CLEARLY = 0.9, 0.1  # least correlation of a command with an effort, and lead over others
LATEST = 0.1  # [s] largest delay of an effort behind its command
FULL_TURNS, DEGREES = 4 * math.pi, 720.0  # range that suggests degrees; largest angle in degrees


def joint_names(log: LogReport) -> dict[str, tuple[str, ...]]:
    """Return the joints of each JointState topic, in the order of its numbers.

    A topic whose messages name different joints is left out, since its indices are ambiguous.
    """
    wanted = {t.topic for t in log.topics if t.type.endswith("/JointState") and t.messages}
    return read_apart(log.files, _joint_names, wanted) if wanted else {}


def _joint_names(files: tuple[Path, ...], wanted: set[str]) -> dict[str, tuple[str, ...]]:
    found: dict[str, set[tuple[str, ...]]] = {topic: set() for topic in wanted}
    for file in files:
        channels: dict[int, Channel] = {}
        for record in log_records(file):
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Messages):
                for identity in record.channel_ids():
                    channel = channels.get(identity)
                    if channel is not None and channel.topic in wanted:
                        found[channel.topic] |= _names_in(record.of(identity), channel.encoding)
    return {topic: names.pop() for topic, names in found.items() if len(names) == 1}


def slides(joint: str) -> bool:
    """Check whether a joint's name is that of a prismatic joint: a trolley, a rail, a lift."""
    words = _words(joint)
    return bool(words & SLIDES) and not words & TURNS


def joint_units(joints: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Return the units of joints' numbers by path: rad for revolute, m for prismatic joints.

    "" for a joint whose name does not show its kind.

    Args:
        joints: see `joint_names`.
    """
    none = dict.fromkeys(TURNING, "")
    return {
        f"{topic}.{kind}[{i}]": unit
        for topic, names in joints.items()
        for i, joint in enumerate(names)
        for kind, unit in (
            SLIDING if slides(joint) else TURNING if _words(joint) & TURNS else none
        ).items()
    }


def _words(joint: str) -> set[str]:
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", joint)}


def _names_in(batch: Messages, encoding: str) -> set[tuple[str, ...]]:
    """Return the lists of names in the first and last message of a batch."""
    from rosbags.typesys import Stores, get_typestore

    ros1 = encoding == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    read = store.deserialize_ros1 if ros1 else store.deserialize_cdr
    found = set()
    for i in {0, len(batch) - 1}:
        data = batch.buffer[int(batch.starts[i]) : int(batch.ends[i])]
        try:
            found.add(tuple(read(data, "sensor_msgs/msg/JointState").name))  # type: ignore[attr-defined]
        except (AttributeError, KeyError, ValueError, IndexError, AssertionError):
            continue  # not a ROS encoding: joints have no names
    return found


def from_base(joints: Sequence[str]) -> tuple[str, ...]:
    """Sort the joints of one limb from its base, by body parts or numbers; else keep the order."""
    if any(_first(SIDES, joint) < len(SIDES) for joint in joints):
        return tuple(joints)
    numbers = {joint: [int(n) for n in re.findall(r"\d+", joint)] for joint in joints}
    for parts in (LIMB, LEG):
        part = {joint: _first(parts, joint) for joint in joints}
        if len(parts) not in part.values():
            within = {
                joint: (part[joint], _first(WITHIN, joint), numbers[joint]) for joint in joints
            }
            return tuple(sorted(joints, key=within.__getitem__))
    counted = len({re.sub(r"\d+", "", joint) for joint in joints}) == 1
    return tuple(sorted(joints, key=numbers.__getitem__)) if counted else tuple(joints)


def _first(words: Sequence[str], joint: str) -> int:
    """Return the index of the first word in a joint's name; `len(words)` if there is none."""
    return next((i for i, word in enumerate(words) if word in joint.lower()), len(words))


def of_joint(
    guess: Guess,
    unit: str,
    joints: Mapping[str, tuple[str, ...]],
    log: LogReport,
    *,
    sent: bool = False,
) -> Guess:
    """Assign a state or input whose name contains a joint's to that joint's number.

    Args:
        guess: of the state or input.
        unit: of the state or input, which decides between position, velocity and effort.
        joints: see `joint_names`.
        log: an inspected log.
        sent: whether it is an input. An array with a command for each joint is then preferred to
            measured efforts, which include the delay and the limits of the drive; measured
            positions and velocities are no commands.
    """
    there = _there(log)
    for topic, names in joints.items():
        for i, joint in enumerate(names):
            if not _holds(guess.name, joint):
                continue
            measured = SLIDING if slides(joint) else TURNING
            kind = next((k for k, u in measured.items() if u == unit), None)
            kind = kind or ("position" if unit in ("m", "1") else None)
            path = f"{topic}.{kind}[{i}]"
            plain = unit == "1"  # commands may be torques, positions or speeds
            torque = sent and kind == "effort"
            if commanded := _commands(log, len(names), plain) if torque or (sent and plain) else []:
                at = from_base(names).index(joint)
                paths = [f"{command}[{at}]" for command in commanded]
                paths += [path] if torque and path in there else []
                rest = [f"{c}[{k}]" for c in commanded for k in range(len(names)) if k != at]
                why = f"commands name no joints; in order from the base, {at} is '{joint}'"
                others = (*paths[1:], *rest)
                return replace(guess, path=paths[0], sure=False, others=others, reasons=(why,))
            measures = kind != "effort" and not COMMAND_TOPIC.search(topic.lower())
            if path in there and not (sent and measures):
                others = tuple(p for p in (guess.path, *guess.others) if p and p != path)
                why = f"{topic} names its joint {i} '{joint}'"
                return replace(guess, path=path, sure=True, others=others[:3], reasons=(why,))
    return guess


def wide_joints(
    guesses: Sequence[Guess],
    units: Mapping[str, str],
    joints: Mapping[str, tuple[str, ...]],
    log: LogReport,
) -> tuple[str, ...]:
    """Return a warning on joints other than wheels that span full turns if they are in rad.

    They are probably in degrees, against the ROS conventions.
    """
    fields = {field.path: field for field in log.numbers}
    called = {f"{t}.position[{i}]": j for t, names in joints.items() for i, j in enumerate(names)}
    found = []
    for one in guesses:
        field, joint = fields.get(one.path), called.get(one.path, "")
        if field is None or field.low is None or field.high is None or units[one.name] != "rad":
            continue
        low, high = (one.scale * end for end in (field.low, field.high))
        if not joint or ROLLS.search(joint.lower()) or abs(high - low) <= FULL_TURNS:
            continue
        if max(abs(low), abs(high)) <= DEGREES:
            found.append(f"{one.name}, from {min(low, high):.3g} to {max(low, high):.3g}")
    if not found:
        return ()
    several = len(found) > 1
    return (
        f"{'; '.join(found)}: full turns of a joint, if {'these are' if several else 'that is'} "
        f"rad. If it is in degrees, set scale = {math.pi / 180:.8g} in [log.state] of each, and of "
        "the joints' velocities too",
    )


def in_order(
    guesses: Mapping[str, Guess],
    units: Mapping[str, str],
    joints: Mapping[str, tuple[str, ...]],
    log: LogReport,
) -> dict[str, Guess]:
    """Assign states in order from the base, if there are as many of a unit as joints.

    Only if none of them has a path yet. Prismatic joints have states in m, revolute ones in rad.
    """
    found: dict[str, Guess] = {}
    if len(joints) != 1:
        return found
    topic, names = next(iter(joints.items()))
    order, there = from_base(names), _there(log)
    kinds = ((k, u, slide) for slide in (False, True) for k, u in (TURNING, SLIDING)[slide].items())
    for kind, unit, slide in kinds:
        some = [joint for joint in order if slides(joint) is slide]
        those = [name for name, guess in guesses.items() if units[name] == unit]
        if len(those) != len(some) or any(guesses[name].path for name in those):
            continue
        commanded = _commands(log, len(names)) if kind == "effort" else []
        own = [next((j for j in some if _holds(name, j)), "") for name in those]
        for name, joint in zip(those, own if set(own) == set(some) else some, strict=True):
            at = order.index(joint)
            paths = [f"{command}[{at}]" for command in commanded]
            paths += [path] if (path := f"{topic}.{kind}[{names.index(joint)}]") in there else []
            if not paths:
                continue
            why = f"in the order of joints from the base, {at} is '{joint}'"
            if len(some) == 1:
                why = f"'{joint}' is the only joint{' that slides' * slide}"
            why = f"no name matches; {why}" if commanded else why
            rest = [f"{c}[{i}]" for c in commanded for i in range(len(names)) if i != at]
            others = (*paths[1:], *rest)
            found[name] = replace(guesses[name], path=paths[0], others=others, reasons=(why,))
    return found


def _there(log: LogReport) -> set[str]:
    """Return the paths of a log, except for constant efforts: many robots leave them at zero."""
    return {
        field.path
        for topic in log.topics
        for field in topic.fields
        if field.low != field.high or ".effort[" not in field.path
    }


def by_efforts(
    guesses: Mapping[str, Guess],
    inputs: Sequence[str],
    joints: Mapping[str, tuple[str, ...]],
    signals: Signals,
    log: LogReport,
) -> dict[str, Guess]:
    """Assign the commands of an array to joints by their correlation with measured efforts.

    If each command correlates with one joint's effort, clearly more than with the others, it is
    assigned to that joint. Otherwise the reasons say where to look it up.

    Args:
        guesses: of all states and inputs.
        inputs: names of inputs.
        joints: see `joint_names`.
        signals: reads the samples.
        log: an inspected log.
    """
    found: dict[str, Guess] = {}
    there = _there(log)
    for (topic, names), name in product(joints.items(), inputs):
        guess = guesses[name]
        own = [joint for joint in names if _holds(name, joint)]
        arrays = [c for c in _commands(log, len(names), True) if guess.path.startswith(f"{c}[")]
        if guess.sure or len(own) != 1 or not arrays or name in found:
            continue
        sent, measured = (
            [f"{array}[{k}]" for k in range(len(names))] for array in (*arrays, f"{topic}.effort")
        )
        joint, torques = names.index(own[0]), arrays[0] in _commands(log, len(names))
        known = torques and there.issuperset(measured)
        at = _goes_with(sent, measured, signals)[joint] if known else None
        if at is None:
            why = "check it by the order of `joints` in the parameters of the controller"
            found[name] = replace(guess, reasons=(*guess.reasons, why))
        else:
            why = f"correlates with {measured[joint]}, the effort of '{own[0]}', clearly more than "
            why += "with any other joint's"
            found[name] = replace(guess, path=sent[at], sure=True, others=(), reasons=(why,))
    return found


def _goes_with(sent: Sequence[str], measured: Sequence[str], signals: Signals) -> list[int | None]:
    """Return the index of the command for each effort; all None unless every one is clear."""
    signals.read([*sent, *measured])
    gridded = signals.grid((*sent, *measured))
    none: list[int | None] = [None] * len(measured)
    if gridded is None:
        return none
    step, columns = gridded
    like = np.full((len(sent), len(measured)), -1.0)
    for late in range(1 + min(round(LATEST / step), len(columns[0]) // 2)):
        u = np.array(columns[: len(sent)])[:, : len(columns[0]) - late]
        y = np.array(columns[len(sent) :])[:, late:]
        if not (np.ptp(u, axis=1).all() and np.ptp(y, axis=1).all()):
            return none
        like = np.maximum(like, np.corrcoef(u, y)[: len(sent), len(sent) :])
    best = like.argmax(axis=0)
    others = like.copy()
    others[best, np.arange(len(measured))] = -1.0
    own = like[best, np.arange(len(measured))]
    rest = np.maximum(others.max(axis=0), others[best].max(axis=1))
    if len(set(best.tolist())) < len(best) or (own < ALIKE).any() or (own - rest < CLEARLY).any():
        return none
    return [int(k) for k in best]


def _commands(log: LogReport, count: int, plain: bool = False) -> list[str]:
    """Return array topics with a torque command for each of `count` joints; `plain`: any kind."""
    words = ("cmd", "command", "effort", "torque", "desired", "ref")
    return [
        f"{topic.topic}.data"
        for topic in log.topics
        if "MultiArray" in topic.type
        and any(word in topic.topic.lower() for word in words)
        and (plain or not any(word in topic.topic.lower() for word in ("position", "velocity")))
        and sum(".data[" in field.path for field in topic.fields) == count
    ]


def _holds(name: str, joint: str) -> bool:
    """Check whether a state's name is a joint's, perhaps with a word for the quantity."""
    plain = re.sub(r"(_?joint_?)", "", joint.lower()) or joint.lower()
    parts = name.lower().split("_")
    return (
        name.lower() in (joint.lower(), plain)
        or any(part in (joint.lower(), plain) for part in parts)
        or plain == "_".join(parts[1:])
        or plain == "_".join(parts[:-1])
    )
