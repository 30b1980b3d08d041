"""The state of ros2_control's trajectory controller: desired and actual in one message."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from grounded_trials.logs.inspection.assignment import assigned
from grounded_trials.logs.inspection.inspect_log import inspect_log
from ros_bags import START, header

KIND = "control_msgs/msg/JointTrajectoryControllerState"
NAMES = ["elbow_joint", "shoulder_joint"]
PARTS = {"new": ("reference", "feedback"), "old": ("desired", "actual")}
POINT = "trajectory_msgs/msg/JointTrajectoryPoint"


def controller(folder: Path, age: str) -> Path:
    """Joints that follow their references with a lag; the elbow comes first in the message."""
    aim, done = PARTS[age]
    fields = "".join(f"{POINT.replace('/msg', '')} {part}\n" for part in (aim, done, "error"))
    store = get_typestore(Stores.ROS2_HUMBLE)
    definition = f"std_msgs/Header header\nstring[] joint_names\n{fields}"
    store.register(get_types_from_msg(definition, KIND))
    T = store.types
    none, still = np.zeros(0), T["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)

    def point(q: np.ndarray) -> object:
        more = {"velocities": none, "accelerations": none, "effort": none}
        return T[POINT](positions=q.copy(), time_from_start=still, **more)

    def messages():
        q, rng = np.zeros(2), np.random.default_rng(0)
        for k in range(300):
            t = START + k * 2 * 10**7
            u = np.array([0.5 * np.sin(0.05 * k), 0.6 * np.sign(np.sin(0.03 * k))])
            seen = q + 1e-3 * rng.normal(size=2)
            states = {aim: point(u), done: point(seen), "error": point(u - seen)}
            yield t, T[KIND](header=header(t), joint_names=NAMES, **states)
            q = q + (1 - np.exp(-0.02 / 0.2)) * (u - q)

    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        open_ = writer.add_connection("/arm/controller_state", KIND, typestore=store)
        for t, message in messages():
            writer.write(open_, t, store.serialize_cdr(message, KIND))
    return folder


@pytest.mark.parametrize("age", PARTS)
def test_what_joints_did_is_the_state_and_what_they_should_do_the_input(
    tmp_path: Path, age: str
) -> None:
    report = inspect_log(controller(tmp_path / "bag", age))
    states, inputs = assigned(
        report,
        {"shoulder_position": "rad", "elbow_position": "rad"},
        {"shoulder_command": "rad", "elbow_command": "rad"},
    )
    aim, done = PARTS[age]
    base = "/arm/controller_state"
    assert [one.path for one in states] == [f"{base}.{done}.positions[{i}]" for i in (1, 0)]
    assert [one.path for one in inputs] == [f"{base}.{aim}.positions[{i}]" for i in (1, 0)]
