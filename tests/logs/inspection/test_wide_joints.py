"""Joints that turn many times round, in rad as ROS has it: they may be degrees, wheels are not."""

import numpy as np
import pytest

from grounded_trials import Workspace
from grounded_trials.starting.begin import begin
from grounded_trials.workspace.inspecting import inspect_in
from ros_bags import START, bag, joints, rover_bag

SCALED = 180 / np.pi


def swinging(folder, scale):
    """An arm of two joints, positions and velocities times `scale`."""

    def messages():
        for k in range(600):
            a, t = np.array([0.02, 0.03]) * k, START + k * 10**7
            q, w = np.array([1.0, 0.7]) * np.sin(a), np.array([2.0, 2.1]) * np.cos(a)
            yield "/joint_states", t, joints(t, names, scale * q, scale * w, np.cos(2 * a))

    names = ["shoulder_joint", "elbow_joint"]
    return bag(folder, {"/joint_states": "sensor_msgs/msg/JointState"}, messages())


@pytest.mark.parametrize(("scale", "wide"), [(1.0, False), (SCALED, True)])
def test_a_joint_that_spans_turns_is_told_where_a_workspace_is_made_of_it(tmp_path, scale, wide):
    log = swinging(tmp_path / "bag", scale)
    made = begin(tmp_path / "w", log, kind="arm")
    told = [note for note in made.notes if "degrees" in note]
    assert len(told) == wide and all(f"scale = {1 / SCALED:.8g}" in note for note in told)
    odd = inspect_in(Workspace(tmp_path / "w"), log).odd
    assert [note for note in odd if "degrees" in note] == told


def test_wheels_may_turn(tmp_path):
    def messages():
        for k in range(300):
            turned = np.array([0.1 * k, 0.12 * k])
            sides = np.full(2, 10.0) + np.sin(0.1 * k)
            yield "/joint_states", k * 10**7, joints(k * 10**7, names, turned, sides, sides)

    names = ["wheel_left", "wheel_right"]
    log = bag(tmp_path / "bag", {"/joint_states": "sensor_msgs/msg/JointState"}, messages())
    made = begin(tmp_path / "w", log, kind="arm")
    assert made.states[0].path and not [note for note in made.notes if "degrees" in note]
    rover = begin(tmp_path / "r", rover_bag(tmp_path / "rover"))
    assert not [note for note in rover.notes if "degrees" in note]
