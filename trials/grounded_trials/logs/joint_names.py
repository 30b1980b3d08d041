"""Which joint each number of a JointState is, and which states of a model are those joints."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

from grounded_trials.formats.mcap_records import Channel, Messages
from grounded_trials.logs.inspect_guess import Guess
from grounded_trials.logs.inspect_log import LogReport
from grounded_trials.logs.log_files import log_records

JOINT_UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m"}


def joint_names(log: LogReport) -> dict[str, tuple[str, ...]]:
    """The joints of each JointState topic, in the order of its numbers.

    A topic whose messages name different joints is left out: an index then means several things.
    """
    wanted = {t.topic for t in log.topics if t.type.endswith("/JointState") and t.messages}
    found: dict[str, set[tuple[str, ...]]] = {topic: set() for topic in wanted}
    for file in log.files if wanted else ():
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


def _names_in(batch: Messages, encoding: str) -> set[tuple[str, ...]]:
    """The lists of names in the first and last message of a batch."""
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
            continue  # another encoding than ROS's: joints go unnamed
    return found


def of_joint(guess: Guess, unit: str, joints: Mapping[str, tuple[str, ...]]) -> Guess:
    """A state whose name holds a joint's is that joint's number of its unit."""
    for topic, names in joints.items():
        for i, joint in enumerate(names):
            if not _holds(guess.name, joint):
                continue
            kind = next((k for k, u in JOINT_UNITS.items() if u == unit), None)
            kind = kind or ("position" if unit in ("m", "1") else None)
            if kind is not None:
                path = f"{topic}.{kind}[{i}]"
                others = tuple(p for p in (guess.path, *guess.others) if p and p != path)
                why = f"{topic} names its joint {i} '{joint}'"
                return replace(guess, path=path, sure=True, others=others[:3], reasons=(why,))
    return guess


def in_order(
    guesses: Mapping[str, Guess],
    units: Mapping[str, str],
    joints: Mapping[str, tuple[str, ...]],
    log: LogReport,
) -> dict[str, Guess]:
    """As many names of a unit as there are joints, none of them found: taken in their order."""
    found: dict[str, Guess] = {}
    if len(joints) != 1:
        return found
    topic, names = next(iter(joints.items()))
    for kind, unit in JOINT_UNITS.items():
        those = [name for name, guess in guesses.items() if units[name] == unit]
        if len(those) != len(names) or any(guesses[name].path for name in those):
            continue
        commanded = _commands(log, len(names)) if kind == "effort" else []
        for i, name in enumerate(those):
            paths = [*(f"{command}[{i}]" for command in commanded), f"{topic}.{kind}[{i}]"]
            why = (f"in the order of the joints: {i} is '{names[i]}'",)
            others = tuple(paths[1:])
            found[name] = replace(guesses[name], path=paths[0], others=others, reasons=why)
    return found


def _commands(log: LogReport, count: int) -> list[str]:
    """Topics of arrays with a command for each of `count` joints."""
    words = ("cmd", "command", "effort", "torque", "desired", "ref")
    return [
        f"{topic.topic}.data"
        for topic in log.topics
        if "MultiArray" in topic.type
        and any(word in topic.topic.lower() for word in words)
        and sum(".data[" in field.path for field in topic.fields) == count
    ]


def _holds(name: str, joint: str) -> bool:
    """Whether a state's name is a joint's with a letter or word for what is measured."""
    plain = re.sub(r"(_?joint_?)", "", joint.lower()) or joint.lower()
    parts = name.lower().split("_")
    return (
        name.lower() in (joint.lower(), plain)
        or any(part in (joint.lower(), plain) for part in parts)
        or plain == "_".join(parts[1:])
        or plain == "_".join(parts[:-1])
    )
