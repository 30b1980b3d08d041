"""Unknown logs, of a crane, a drone, an arm: what is found in them, said about them, proposed."""

from __future__ import annotations

import struct
import tomllib
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import ros_bags
from facts import holding
from grounded.errors import GroundedError
from grounded_trials.formats.mcap_records import Channel, Schema
from grounded_trials.formats.messages import decoder_of
from grounded_trials.formats.path_walk import number_paths
from grounded_trials.logs.inspection.assignment import assigned
from grounded_trials.logs.inspection.guess import mapping_toml
from grounded_trials.logs.inspection.inspect_log import inspect_log
from grounded_trials.logs.log_table import LogMapping, read_log
from grounded_trials.logs.signals import SignalSpec, read_signals
from grounded_trials.starting.begin import begin
from grounded_trials.starting.shapes import Drive, path_target
from grounded_trials.workspace.user_files.model_file import load_module, model_in
from ros_bags import START, crane_bag, header
from shared_data import data, needs_data

MODEL = """from grounded import Model

model = Model(
    states={"x": "m", "v": "m/s", "th": "rad", "w": "rad/s"},
    inputs={"volts": "V"},
    derivative=lambda s, a, p: {"x": s.v, "v": a.volts - s.v, "th": s.w, "w": -s.th - s.v},
)
"""


def found_in(folder, **renamed):
    """The guesses for a cart-pole's table, some columns of it under other names, or beside."""
    t = np.arange(0, 30, 0.02)
    phase = 1.3 * t + 0.02 * t**2
    x, v = 0.2 * np.sin(phase), 0.2 * (1.3 + 0.04 * t) * np.cos(phase)
    th, w = 40 * np.sin(5.1 * t), 40 * 5.1 * np.cos(5.1 * t)
    columns = {
        "cart_mm": 1e3 * x,
        "cart_speed": 1e3 * v,
        "pole_deg": th,
        "pole_speed": w,
        "volts": np.round(4 * np.sin(3 * t + np.sin(0.4 * t)), 1),
    }
    columns = {renamed.get(name, name): values for name, values in columns.items()}
    columns |= {"belt_mm": 1e3 * x + 5 * np.sin(9 * t)} if "belt" in renamed else {}
    rows = np.column_stack([1e3 * t, *columns.values()])
    head = ",".join(("time_ms", *columns))
    np.savetxt(folder / "hand.csv", rows, "%.6f", ",", header=head, comments="")
    (folder / "m.py").write_text(MODEL)
    done = begin(folder / "w", folder / "hand.csv", model=folder / "m.py")
    return {g.name: g for g in done.states}


def test_what_unit_derivative_and_the_only_pair_agree_on_is_sure(tmp_path):
    by = found_in(tmp_path)
    assert {name: g.path for name, g in by.items()} == {
        "x": "/csv.cart_mm",
        "v": "/csv.cart_speed",
        "th": "/csv.pole_deg",
        "w": "/csv.pole_speed",
    }
    assert all(g.sure and not g.others for g in by.values())
    assert by["x"].scale == by["v"].scale == 1e-3
    assert by["th"].scale == by["w"].scale == pytest.approx(np.pi / 180)


def test_without_a_unit_it_is_asked(tmp_path):
    by = found_in(tmp_path, pole_deg="pole")
    assert not by["th"].sure and by["x"].sure


@pytest.mark.parametrize("sign", [1, -1])
def test_a_rate_of_the_opposite_sign_is_asked(tmp_path, sign):
    """Of a slow swing, an exchange fits as well: either is possible."""
    t = np.arange(0, 30, 0.02)
    rows = np.column_stack([t, np.sin(t), sign * np.cos(t), np.round(np.sin(3 * t), 1)])
    np.savetxt(tmp_path / "a.csv", rows, "%.6f", ",", header="t,th,w,volts", comments="")
    text = MODEL.replace('"x": "m", "v": "m/s", ', "").replace('"x": s.v, "v": a.volts - s.v, ', "")
    (tmp_path / "m.py").write_text(text.replace("- s.v}", "+ a.volts}"))
    done = begin(tmp_path / "w", tmp_path / "a.csv", model=tmp_path / "m.py")
    _, w = done.states
    assert w.sure == (sign > 0) and w.scale == sign


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


CRANE = """import numpy as np
from grounded import Model, Param

def dynamics(s, a, p):
    sn, cs = np.sin(s.{th}), np.cos(s.{th})
    force = p.kF * a.voltage - p.c * s.v
    acc = (force + p.m * p.L * s.w**2 * sn + p.m * 9.81 * sn * cs) / (p.M + p.m * sn**2)
    return {{"x": s.v, "v": acc, "{th}": s.w, "w": -(acc * cs + 9.81 * sn) / p.L}}

model = Model(
    states={{"x": "m", "v": "m/s", "{th}": "rad", "w": "rad/s"}}, inputs={{"voltage": "V"}},
    params={{"M": Param(6.0, "kg"), "m": Param(2.0, "kg"), "kF": Param(5.0, "N/V", 3.0, 8.0),
            "c": Param(3.0, "N s/m", 0.0, 10.0), "L": Param(1.0, "m", 0.5, 1.6)}},
    roles={{"rail": "x", "hanging": ("{th}",)}}, angles=("{th}",), derivative=dynamics)
"""


RIGHT = {
    "x": "/joint_states.position[0]",
    "v": "/joint_states.velocity[0]",
    "w": "/sway/state.rate",
    "voltage": "/motor/command.voltage",
}


@pytest.mark.parametrize("joint, th", [("trolley", "th"), ("trolley", "beta"), ("axis_1", "beta")])
def test_a_trolley_and_its_load_are_told_apart(tmp_path, joint, th):
    """By names and units where they say it, by their rates where they don't."""
    (tmp_path / "mine.py").write_text(CRANE.format(th=th))
    log = crane_bag(tmp_path / "bag", joint)
    found = begin(tmp_path / "w", log, model=tmp_path / "mine.py")
    paths = {guess.name: guess.path for guess in (*found.states, *found.inputs)}
    assert paths == RIGHT | {th: "/sway/state.angle"}
    assert found.dt == 0.04
    if joint == "trolley":
        assert not {"x", "v"} & {guess.name for guess in found.unsure}


def test_what_steps_do_not_tell_is_unsure_as_a_group_and_the_rivals_are_named(tmp_path):
    """Two integrators in one unit: either may be either."""
    text = CRANE.format(th="th").split("def dynamics")[0] + (
        "def f(s, a, p):\n"
        '    return {"a": s.da, "da": 0 * s.a, "b": s.db, "db": 0 * s.b}\n'
        'model = Model(states={"a": "1", "da": "1/s", "b": "1", "db": "1/s"},\n'
        '    inputs={"voltage": "V"}, params={}, derivative=f)\n'
    )
    (tmp_path / "mine.py").write_text(text)
    found = begin(tmp_path / "w", crane_bag(tmp_path / "bag", "axis_1"), model=tmp_path / "mine.py")
    assert {guess.name for guess in found.unsure} == {"a", "da", "b", "db"}
    assert all(guess.path and guess.others for guess in found.states)


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


def listed(log, states, inputs):
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
    states, inputs = listed(report, ["v", "x", "y", "psi"], ["throttle"])
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
    states, inputs = listed(report, ["v", "x", "y", "psi"], ["steering", "throttle"])
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
