"""Unknown logs: what is found in them, said about them, and proposed for them."""

from __future__ import annotations

import struct
import tomllib

import numpy as np
import pytest

from facts import holding
from grounded.errors import GroundedError
from grounded_trials.formats.mcap_records import Channel, Schema
from grounded_trials.formats.messages import decoder_of
from grounded_trials.formats.path_walk import number_paths
from grounded_trials.logs.inspection.assignment import assigned
from grounded_trials.logs.inspection.guess import mapping_toml
from grounded_trials.logs.inspection.inspect_log import inspect_log
from grounded_trials.logs.log_table import LogMapping, read_log
from grounded_trials.logs.signals import SignalSpec
from shared_data import data, needs_data


def by_name(log, states, inputs):
    """Return the guesses for states and inputs of which only the names are known."""
    return assigned(log, dict.fromkeys(states, ""), dict.fromkeys(inputs, ""))


@needs_data
def test_a_gap_in_a_genuine_bag_is_refused_where_it_is() -> None:
    pose = "/vicon/Group466CF/Group466CF/pose.pose.position."
    mapping = LogMapping(
        {name: SignalSpec(pose + name) for name in "xyz"},
        {"thrust": SignalSpec("/cf_controll.position.z", "log")},
    )
    bag = data("crazyflie_p4_ros2_mcap", "yx3bag.mcap")
    with pytest.raises(GroundedError, match=r" 2.846 s\b.* 2.996 s"):
        read_log(bag, mapping, 0.02)
    states = {name: SignalSpec(pose + name, max_age_s=1.0) for name in "xyz"}
    found = read_log(bag, LogMapping(states, mapping.inputs), 0.02)
    assert found.reports[0].bridged >= 46 and len(found.states) > 150
    nan = LogMapping({"x": SignalSpec("/cf_logpos.position.x", "log")}, mapping.inputs)
    with pytest.raises(GroundedError, match=holding(236, "finite")):
        read_log(data("crazyflie_p4_ros2_mcap", "yx4bag.mcap"), nan, 0.02)


@needs_data
def test_simulation_time_is_said() -> None:
    report = inspect_log(data("mcap_format_fixtures", "evo", "nav2_turtlebot_SIM.mcap"))
    assert report.simulated
    states, inputs = by_name(report, ["v", "x", "y", "psi"], ["throttle"])
    assert [g.path for g in states] == [
        "/odom.twist.twist.linear.x",
        "/odom.pose.pose.position.x",
        "/odom.pose.pose.position.y",
        "/odom.pose.pose.orientation.@rpy.yaw",
    ]
    table = tomllib.loads(mapping_toml(states, inputs, simulated=True))
    assert table["log"]["clock"] == "log" and "input" not in table["log"]


@needs_data
def test_dart_from_an_unknown_bag_to_arrays() -> None:
    path = data("dart_small_car", "dart_4_sept_random_driving_slow_ros2.mcap")
    report = inspect_log(path)
    states, inputs = by_name(report, ["v", "x", "y", "psi"], ["steering", "throttle"])
    assert [g.path for g in inputs] == ["/steering_1.data", "/throttle_1.data"]
    assert [g.sure for g in states] == [False, True, True, True] and states[0].path == ""
    text = mapping_toml(states, inputs)
    assert "\n# [log.state.v]" in text
    log = tomllib.loads(text)["log"]
    assert log["clock"] == "header" and log["state"]["psi"]["unwrap"] is True
    measured = tomllib.loads(text)["estimate"]["measured"]
    assert set(measured) == {"x", "y", "psi"} and 1e-4 < measured["x"] < 5e-3
    specs = {
        kind: {n: SignalSpec(**{"clock": log["clock"], **s}) for n, s in log[kind].items()}
        for kind in ("state", "input")
    }
    found = read_log(path, LogMapping(specs["state"], specs["input"]), 0.05)
    assert found.states.shape == (1260, 3) and found.inputs.shape == (1259, 2)
    assert found.findings == () and np.abs(np.diff(found.states[:, 2])).max() < 0.3


def test_number_paths() -> None:
    text = (
        "std_msgs/Header header\nfloat64[36] covariance\nfloat64[2] pair\nQ q\nQ[] many\nstring s\n"
        + "=" * 80
        + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
        + "=" * 80
        + "\nMSG: x/Q\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
    )
    schema = Schema(1, "x/msg/M", "ros2msg", text.encode())
    message = b"\0\1\0\0" + struct.pack("<III4s", 0, 0, 1, b"") + bytes(8 * (36 + 2 + 4))
    message += struct.pack("<I4x", 1) + bytes(32) + struct.pack("<I1s", 1, b"")
    one = decoder_of(Channel(1, "/t", "cdr", 1, {}), schema).decode(message)
    angles = [".@rpy.roll", ".@rpy.pitch", ".@rpy.yaw", ".x", ".y", ".z", ".w"]
    assert number_paths(one) == [
        ".pair[0]",
        ".pair[1]",
        *(".q" + a for a in angles),
        *(".many[0]" + a for a in angles),
    ]
    sample = {"a": 1, "b b": [True, {"c": 2.5}], "t": "text", "n": None}
    assert number_paths(sample) == [".a", '."b b"[0]', '."b b"[1].c']
    deep: dict[str, object] = {}
    for _ in range(50):
        deep = {"d": deep, "v": 1}
    assert len(number_paths(deep)) < 20


@needs_data
@pytest.mark.parametrize(("bag", "named"), [("yx3bag", "0.930 s"), ("flybag", "/cf_command")])
def test_the_crazyflie_bags_defects_are_found(bag: str, named: str) -> None:
    report = inspect_log(data("crazyflie_p4_ros2_mcap", f"{bag}.mcap"))
    assert any(named in remark for remark in report.remarks), report.remarks
