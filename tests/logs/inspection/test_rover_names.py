"""What a rover's table calls its commands: a speed and a turn rate, in words of many teams."""

import numpy as np
import pytest

from grounded_trials.starting.begin import begin
from grounded_trials.workspace.folder import Folder
from ros_bags import rover_bag


def table(path, names):
    """A rover's drive with the columns t, x, y, yaw, v, omega, and two commands."""
    t = np.arange(0, 20, 0.05)
    speed, turn = 0.4 + 0.2 * np.sign(np.sin(0.9 * t)), 0.8 * np.sign(np.sin(1.3 * t))
    v, omega, yaw, x, y = (np.zeros(len(t)) for _ in range(5))
    for k in range(len(t) - 1):
        v[k + 1] = v[k] + 0.05 * (speed[k] - v[k]) / 0.3
        omega[k + 1] = omega[k] + 0.05 * (turn[k] - omega[k]) / 0.2
        yaw[k + 1] = yaw[k] + 0.05 * omega[k]
        x[k + 1] = x[k] + 0.05 * v[k] * np.cos(yaw[k])
        y[k + 1] = y[k] + 0.05 * v[k] * np.sin(yaw[k])
    columns = (t, x, y, yaw, v, omega, speed, turn)
    np.savetxt(path, np.column_stack(columns), "%.6f", ",", header=",".join(names), comments="")
    return path


@pytest.mark.parametrize(
    ("measured", "sent"),
    [
        (("v [m/s]", "yaw_rate [rad/s]"), ("cmd_v [m/s]", "cmd_w [rad/s]")),
        (("v", "omega"), ("cmd_vel.linear.x", "cmd_vel.angular.z")),
    ],
)
def test_a_speed_and_a_turn_rate_command_are_a_rover_s(tmp_path, measured, sent):
    log = table(tmp_path / "drive.csv", ("time", "x", "y", "yaw", *measured, *sent))
    done = begin(tmp_path / "w", log)
    assert done.kind == "rover" and done.then.verb == "ingest"
    found = {g.name: g.path for g in (*done.states, *done.inputs)}
    word = [name.partition(" ")[0].replace(".", "_") for name in sent]
    assert [found["speed"], found["turn"]] == [f"/csv.{name}" for name in word]
    assert all(found[name] for name in ("v", "omega", "x", "y", "psi"))


def test_commands_beside_a_camera_s_poses_are_no_measured_speeds(tmp_path):
    done = begin(tmp_path / "w", rover_bag(tmp_path / "bag", seen="/mocap"))
    found = {g.name: g.path for g in (*done.states, *done.inputs)}
    assert found["speed"] == "/cmd_vel.linear.x" and found["turn"] == "/cmd_vel.angular.z"
    assert not found["v"] and not found["omega"] and found["x"] == "/mocap.pose.position.x"
    config = Folder(tmp_path / "w").config
    assert config.file.read_text().count("the smoother estimates v, omega") == 1
