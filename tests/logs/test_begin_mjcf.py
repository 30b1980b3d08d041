"""A workspace from somebody else's log and the MuJoCo file of their robot."""

import shutil
import struct

import numpy as np
import pytest

from cli import grounded
from grounded_trials import Workspace
from grounded_trials.starting.begin import begin
from ros_bags import commanded_arm_bag

pytest.importorskip("mujoco", reason="the adapter's extra, .[mujoco]")
MJCF = """
<mujoco model="arm">
  <option timestep="0.004" integrator="implicitfast"/>
  <worldbody>
    <body><joint name="shoulder_joint" axis="0 -1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.35" size="0.02" mass="2" contype="0"/>
      <body pos="0 0 -0.35"><joint name="elbow_joint" axis="0 -1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="1.2" contype="0"/></body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder" joint="shoulder_joint"/><motor name="elbow" joint="elbow_joint"/>
  </actuator>
</mujoco>"""


URDF = """
<robot name="slider">
  <mujoco><compiler meshdir="{folder}" strippath="true"/></mujoco>
  <link name="base"/>
  <link name="cart"><inertial><mass value="2"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><mesh filename="package://robot/a.stl"/></geometry></collision></link>
  <joint name="rail" type="prismatic"><parent link="base"/><child link="cart"/>
    <axis xyz="1 0 0"/><limit lower="-9" upper="9" effort="5" velocity="10"/></joint>
</robot>"""


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return commanded_arm_bag(tmp_path_factory.mktemp("log") / "bag", measured_torques=True)


@pytest.mark.parametrize("xml", ["arm.xml", "model.py"])
def test_an_mjcf_file_is_a_model_and_comes_along(tmp_path, monkeypatch, log, xml):
    robot, w = tmp_path / "robot", tmp_path / "w"
    robot.mkdir()
    (robot / "arm.xml").write_text(MJCF)
    named = 'from grounded.adapters import mujoco\nmodel = mujoco.model("arm.xml")\n'
    (robot / "model.py").write_text(named)
    done = grounded("init", w, "--from", log, "--model", robot / xml, "--yes", "--json")
    paths = {one["name"]: one["path"] for one in done.json["signals"]}
    assert paths["shoulder"] == "/effort_controller/commands.data[0]"
    assert paths["elbow_joint_vel"] == "/joint_states.velocity[0]"
    assert (w / "arm.xml").read_bytes() == (robot / "arm.xml").read_bytes()
    assert "NumPy" not in (w / "grounded.toml").read_text()
    shutil.rmtree(robot)
    moved = w.rename(tmp_path / "moved")
    monkeypatch.chdir(tmp_path)
    assert Workspace("moved").base_model.input_names == ("shoulder", "elbow")
    refused = grounded("init", moved / "x", "--blank", "--model", "missing.xml")
    assert refused.code == 1 and "missing.xml" in refused.err


def test_limits_of_a_model_file_are_taken_without_a_log_and_told_beside_those_of_one(tmp_path, log):
    limited = MJCF.replace('joint="shoulder_joint"/>', 'joint="shoulder_joint" ctrlrange="-9 8"/>')
    (tmp_path / "arm.xml").write_text(limited)
    grounded("init", tmp_path / "blank", "--blank", "--model", tmp_path / "arm.xml")
    task = Workspace(tmp_path / "blank").task
    assert (task.low[0], task.high[0]) == (-9.0, 8.0) and np.isinf(task.high[1])
    begin(tmp_path / "w", log, model=tmp_path / "arm.xml")
    task = Workspace(tmp_path / "w").task
    assert np.isfinite(task.high).all() and task.high[0] != 8.0  # what the log shows is less
    told = [
        line
        for line in (tmp_path / "w" / "grounded.toml").read_text().split("\n")
        if "file says" in line
    ]
    assert len(told) == 1 and told[0].startswith("shoulder =") and "[-9, 8]" in told[0]


@pytest.mark.parametrize("inside", [True, False])
def test_meshes_of_a_urdf_come_along_from_its_own_folder(tmp_path, inside):
    """MuJoCo names the files of an MJCF, and of a URDF none but itself."""
    robot, w = tmp_path / "robot", tmp_path / "w"
    meshes = robot / "meshes" if inside else tmp_path / "meshes"
    meshes.mkdir(parents=True)
    robot.mkdir(exist_ok=True)
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    corners = np.vstack([np.zeros(3), 0.1 * np.eye(3)])
    rows = [struct.pack("<12f2x", 0, 0, 0, *corners[list(face)].ravel()) for face in faces]
    (meshes / "a.stl").write_bytes(bytes(80) + struct.pack("<I", len(faces)) + b"".join(rows))
    folder = "meshes" if inside else "../meshes"
    (robot / "a.urdf").write_text(URDF.format(folder=folder))
    assert grounded("init", w, "--blank", "--model", robot / "a.urdf").code == 0
    assert (w / "meshes" / "a.stl").is_file() is (w / "a.urdf").is_file() is inside
    assert str(robot) in (w / "model.py").read_text() or inside
    assert Workspace(w).base_model.input_names == ("rail_force",)


MARKED = """
<mujoco><compiler angle="radian"/><worldbody>
  <body><joint name="lift" axis="0 1 0" range="-3 -1" limited="true"/>
    <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.02" mass="2" contype="0" conaffinity="0"/>
    <body pos="0.4 0 0"><joint name="wrist" axis="0 1 0" range="-2 2" limited="true"/>
      <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass="1" contype="0" conaffinity="0"/>
    </body></body>
  <body><joint name="goal" type="slide"/><geom size="0.05" contype="0" conaffinity="0"/></body>
</worldbody><actuator>
  <motor name="m1" joint="lift" ctrlrange="-30 30"/><motor name="m2" joint="wrist"/>
</actuator></mujoco>"""


def test_an_arm_starts_inside_its_ranges_and_held_and_is_planned_at_once(tmp_path):
    (tmp_path / "arm.xml").write_text(MARKED)
    done = grounded("init", tmp_path / "w", "--blank", "--model", tmp_path / "arm.xml", "--json")
    told = {one["code"]: one["about"] for one in done.json["findings"]}
    assert told == {"start.unmoved": ["goal"], "start.outside": ["lift"]}
    workspace = Workspace(tmp_path / "w")
    start, model = workspace.config.task.start, workspace.base_model
    assert model.state_names == ("lift", "wrist", "lift_vel", "wrist_vel")
    assert start["lift"] == -2.0 and abs(start["m1"]) > 1.0
    t = np.linspace(0, 1, 41)
    lift = -2.0 + 0.4 * (3 * t**2 - 2 * t**3)
    workspace.target({"lift": lift, "wrist": np.zeros(41)})
    steps = []
    stepper = Workspace(tmp_path / "w").base_model.step
    advance = type(stepper).advance

    def counted(own, x, u, p, dt):
        steps.append(len(x))
        return advance(own, x, u, p, dt)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(stepper), "advance", counted)
        proposed = workspace.propose()
    assert sum(steps) < 10_000  # 40 steps, 7 samples for the slopes of each: 280 an iteration
    assert proposed.candidate.predicted_utility > -0.5
