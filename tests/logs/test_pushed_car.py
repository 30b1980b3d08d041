"""A car that a duty drives: its skeleton has that input, and no plan is made for an unknown one."""

import re

import numpy as np
import pytest

from cli import grounded, plain
from grounded.errors import GroundedError
from grounded_trials import Workspace
from grounded_trials.starting.begin import begin
from ros_bags import START, T, bag, header, odometry, vector

FULL, LAG, BASE = 5.0, 0.4, 0.33  # [m/s] at a duty of 1, [s], [m]
STEPS, DT = 1500, 0.02


def driven():
    """A car on duty and steering: t, v, x, y, psi, steering, duty."""
    t = np.arange(STEPS) * DT
    duty = 0.15 + 0.15 * (np.floor(t / 3) % 3) * (t > 1)
    duty[t < 1] = 0.0
    steering = 0.3 * np.sin(0.9 * t)
    rows, (v, x, y, psi) = [], np.zeros(4)
    for now, a, u in zip(t, steering, duty, strict=True):
        rows.append((now, v, x, y, psi, a, u))
        v += DT * (FULL * u - v) / LAG
        x, y = x + DT * v * np.cos(psi), y + DT * v * np.sin(psi)
        psi += DT * v * np.tan(a) / BASE
    return np.array(rows)


def table(folder, *names):
    log = folder / "drive.csv"
    head = ",".join(("t", "v", "x", "y", "psi", *names))
    np.savetxt(log, driven(), "%.5f", ",", header=head, comments="")
    return log


@pytest.mark.parametrize(
    ("name", "unit"), [("duty", "1"), ("motor_pwm", "1"), ("voltage_V", "V"), ("throttle", "1")]
)
def test_a_car_without_a_speed_command_is_driven_by_what_its_log_has(tmp_path, name, unit):
    found = begin(tmp_path / "w", table(tmp_path, "steering", name), kind="car")
    assert [g.path for g in found.inputs] == ["/csv.steering", f"/csv.{name}"]
    model = Workspace(tmp_path / "w").task.model
    own = found.inputs[1].name
    assert own in name and model.inputs == {"steering": model.inputs["steering"], own: unit}
    gain = model.params["gain"]
    assert gain.value == pytest.approx(FULL, rel=0.1)
    assert gain.unit == ("m/s" if unit == "1" else f"m/s/{unit}")
    assert gain.low < FULL / 2 and gain.high > 2 * FULL


def test_a_speed_command_comes_before_a_motor_s(tmp_path):
    rows = driven()
    log = tmp_path / "drive.csv"
    both = np.column_stack([rows, FULL * rows[:, -1]])
    head = "t,v,x,y,psi,steering,motor_duty,speed_cmd"
    np.savetxt(log, both, "%.5f", ",", header=head, comments="")
    found = begin(tmp_path / "w", log, kind="car")
    assert [g.name for g in found.inputs] == ["steering", "speed"]
    assert Workspace(tmp_path / "w").task.model.params["gain"].value == 1.0


def test_no_plan_is_made_for_an_input_that_log_does_not_map(tmp_path):
    """A node sent a speed of 1.6 m/s as the duty of its motor."""
    w = tmp_path / "w"
    begin(w, table(tmp_path, "steering", "duty"), kind="car")
    file = w / "grounded.toml"
    mapped = file.read_text()
    file.write_text(mapped.replace("[log.input.duty]", "[log.input.steering2]"))
    assert grounded("-C", w, "propose").code == 1  # an unknown name
    file.write_text(mapped)
    assert grounded("-C", w, "propose").code == 0
    without = re.sub(r"\[log\.input\.duty\]\npath[^\n]*\n", "", mapped)
    assert without != mapped
    file.write_text(without)
    for refused in (("propose",), ("export", "c0001", "-o", tmp_path / "c.npz")):
        done = grounded("-C", w, *refused)
        assert done.code == 1 and "[log] maps no 'duty'" in plain(done.err)
        assert done.err.split()[-1] == "LOG"
    assert not (tmp_path / "c.npz").exists()
    stands = grounded("-C", w, "status")
    assert "[log] maps no 'duty'" in plain(stands.err) and stands.out.split()[-1] == "LOG"
    anyway = grounded("-C", w, "export", "c0001", "-o", tmp_path / "c.npz", "--anyway")
    assert anyway.code == 0 and "[log] maps no 'duty'" in plain(anyway.err)
    file.write_text(without[: without.index("[log]")])  # no [log] at all: its own simulator
    Workspace(w).propose()
    file.write_text(without + '\n[system]\nmodel = "model.py"\n')
    Workspace(w).propose()
    file.write_text(without)
    with pytest.raises(GroundedError, match="maps no 'duty'"):
        Workspace(w).propose()


def imu(t, turn, ahead):
    zero = T["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    return T["sensor_msgs/msg/Imu"](
        header=header(t),
        orientation=zero,
        orientation_covariance=np.zeros(9),
        angular_velocity=vector("Vector3", 0.01 * turn, 0.02 * turn, turn),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector("Vector3", ahead, 0.1 * ahead, 9.81 + 0.01 * ahead),
        linear_acceleration_covariance=np.zeros(9),
    )


@pytest.mark.parametrize("posed", [True, False])
def test_an_imu_comes_after_the_odometry_in_a_generic_model(tmp_path, posed):
    topics = {"/imu/data": "sensor_msgs/msg/Imu", "/odom": "nav_msgs/msg/Odometry"}
    topics |= dict.fromkeys(("/cmd/steering", "/cmd/duty"), "std_msgs/msg/Float64")
    number, messages = T["std_msgs/msg/Float64"], []
    for now, v, x, y, psi, steering, duty in driven()[:500]:
        t = START + round(now * 1e9)
        messages += [
            ("/imu/data", t, imu(t, v * np.tan(steering) / BASE, duty - v / FULL)),
            ("/cmd/steering", t, number(data=steering)),
            ("/cmd/duty", t, number(data=duty)),
        ]
        messages += [("/odom", t, odometry(t, x, y, psi, v, v * np.tan(steering) / BASE))] * posed
    log = bag(tmp_path / "bag", topics, messages)
    found = begin(tmp_path / "w", log, inputs=("steering", "duty"))
    paths = {g.name: g.path for g in found.states}
    assert not any("linear_acceleration" in paths.get(axis, "") for axis in "xyz")
    if posed:
        names = ["x", "y", "yaw", "linear_x", "angular_z"]
        assert list(paths)[: len(names)] == names
        assert all(paths[name].startswith("/odom.") for name in names)
        (v,) = (g for g in begin(tmp_path / "car", log, kind="car").states if g.name == "v")
        assert any("speed forwards" in why for why in v.reasons)  # linear.y is in m/s as well


@pytest.mark.parametrize("speeds", [True, False])
def test_init_says_where_a_run_starts_or_why_that_is_open(tmp_path, speeds):
    """One planned from -0.10 and ran from -0.15: `start` is empty for logs without speeds."""
    (tmp_path / "cart.py").write_text(
        "from grounded import Model\n"
        "model = Model(states={'x': 'm', 'v': 'm/s'}, inputs={'force': 'N'},\n"
        "    derivative=lambda s, a, p: {'x': s.v, 'v': a.force})\n"
    )
    t = np.arange(300) * 0.02
    since = np.clip(t - 1, 0, None)
    x, v, force = -0.1 + 1 - np.cos(since), np.sin(since), np.cos(since) * (t > 1)
    columns, head = [t, x, force], "t,x,force"
    if speeds:
        columns, head = [t, x, v, force], "t,x,v,force"
    log = tmp_path / "a.csv"
    np.savetxt(log, np.column_stack(columns), "%.5f", ",", header=head, comments="")
    done = grounded("init", tmp_path / "w", "--from", log, "--model", tmp_path / "cart.py")
    said = " ".join(done.out.split())
    told = "start x = -0.1, where it stood" if speeds else "start empty, no rest is seen without v"
    assert told in said
    assert Workspace(tmp_path / "w").config.task.start == ({"x": -0.1} if speeds else {})
