"""A drone's log as mavros writes it: body velocities in the odometry, an attitude as command."""

import pytest

import ros_bags
from facts import holding
from grounded.errors import GroundedError
from grounded_trials.logs.signals import SignalSpec, read_signals
from grounded_trials.starting.begin import begin
from grounded_trials.starting.shapes import Drive, path_target
from grounded_trials.workspace.user_files.model_file import load_module, model_in

ODOMETRY, COMMAND = "/mavros/local_position/odom", "/mavros/setpoint_raw/attitude"


def by_name(found):
    return {guess.name: guess for guess in (*found.states, *found.inputs)}


def test_everything_of_a_drone_is_found(tmp_path):
    """Velocities are turned into the frame of the position; a steady yaw becomes a constant."""
    found = begin(tmp_path / "w", ros_bags.drone_bag(tmp_path / "bag"))
    by = by_name(found)
    assert found.kind == "drone" and all(guess.sure for guess in by.values())
    assert [by[f"v{axis}"].path for axis in "xyz"] == [
        f"{ODOMETRY}.@world_velocity.{axis}" for axis in "xyz"
    ]
    assert by["pitch_command"].path == f"{COMMAND}.orientation.@rpy.pitch"
    assert by["thrust"].path == f"{COMMAND}.thrust"
    model = model_in(load_module(tmp_path / "w", "model.py"))
    assert model.params["yaw"].value == pytest.approx(1.4, abs=0.01)
    assert "yaw" not in model.states


def test_a_drone_that_turns_has_its_yaw_as_a_state(tmp_path):
    found = begin(tmp_path / "w", ros_bags.drone_bag(tmp_path / "bag", turning=0.8))
    by = by_name(found)
    assert by["yaw"].path == f"{ODOMETRY}.pose.pose.orientation.@rpy.yaw" and by["yaw"].sure
    assert by["yaw_command"].path == f"{COMMAND}.orientation.@rpy.yaw"
    model = model_in(load_module(tmp_path / "w", "model.py"))
    assert model.angles == ("yaw",)


def test_the_velocity_in_the_world_needs_an_odometry(tmp_path):
    bag = ros_bags.drone_bag(tmp_path / "bag")
    path = f"{COMMAND}.@world_velocity.x"
    with pytest.raises(GroundedError, match=holding("pose.pose.orientation")):
        read_signals((next(bag.glob("*.db3")),), {"v": SignalSpec(path)})


def test_a_path_of_a_drone_keeps_its_height(tmp_path):
    """Left free, the height would be what costs least: the drone would sink."""
    begin(tmp_path / "w", ros_bags.drone_bag(tmp_path / "bag"))
    model = model_in(load_module(tmp_path / "w", "model.py"))
    with pytest.raises(GroundedError, match=holding("--to z")):
        path_target("circle", Drive(), model, 0.02)
    columns = path_target("circle", Drive(), model, 0.02, {"z": 1.5}, {"x": 0.4, "z": 3.0})
    assert set(columns) == {"x", "y", "z"} and columns["x"][0] == pytest.approx(0.4)
    assert (columns["z"] == 1.5).all()
    assert (path_target("line", Drive(), model, 0.02, {}, {"z": 3.0})["z"] == 3.0).all()
    with pytest.raises(GroundedError, match=holding("--to x=1")):
        path_target("circle", Drive(), model, 0.02, {"x": 1.0, "z": 1.0})
