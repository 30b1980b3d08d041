"""Runs as ROS 2 bags: rosbags reads them, and so do we, and the robot is seen."""

import json
from xml.etree import ElementTree

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from cli import grounded
from grounded_trials import Workspace
from grounded_trials.logs.inspection.inspect_log import inspect_log
from grounded_trials.logs.signals import SignalSpec, read_signals
from grounded_trials.report.layouts import write_layouts


@pytest.fixture(scope="module")
def car(tmp_path_factory):
    folder = tmp_path_factory.mktemp("w") / "car"
    grounded("init", folder, "--example", "car-turn")
    assert grounded("-C", folder, "learn", "--trials", 1).code == 0
    return folder


@pytest.mark.parametrize("name", ["run_bag", "run_mcap"])
def test_a_trial_as_a_bag_is_read_by_rosbags(car, tmp_path, name):
    done = grounded(
        "-C", car, "export", "t0001", "--format", "bag", "-o", tmp_path / name, "--json"
    )
    assert done.json["format"] == "bag"
    trial = Workspace(car).trials()[0].trial
    store = get_typestore(Stores.ROS2_HUMBLE)
    poses = []
    with AnyReader([tmp_path / name], default_typestore=store) as bag:
        topics = {c.topic for c in bag.connections}
        for connection, time, raw in bag.messages():
            if connection.topic == "/pose":
                pose = bag.deserialize(raw, connection.msgtype).pose
                poses.append((time * 1e-9, pose.position.x, pose.position.y, pose.orientation))
    assert topics >= {"/odom", "/tf", "/target", "/state/v", "/input/steering"}
    t, x, y, turns = zip(*poses, strict=True)
    index = trial.state_names.index
    np.testing.assert_allclose(t, trial.dt * np.arange(trial.steps + 1), atol=1e-6)
    np.testing.assert_allclose(x, trial.states[:, index("x")])
    np.testing.assert_allclose(y, trial.states[:, index("y")])
    yaw = np.unwrap([2 * np.arctan2(q.z, q.w) for q in turns])
    np.testing.assert_allclose(yaw, trial.states[:, index("psi")], atol=1e-9)


def test_what_was_exported_is_read_back(car, tmp_path):
    trial = Workspace(car).trials()[0].trial
    v = trial.states[:, trial.state_names.index("v")]
    for form, path in (("bag", "/state/v.data"), ("csv", "/csv.v"), ("npz", "/npz.v")):
        file = tmp_path / f"run.{form}"
        assert grounded("-C", car, "export", "t0001", "--format", form, "-o", file).code == 0
        clock = "log" if form == "bag" else "header"
        found = read_signals(file, {"v": SignalSpec(path, clock=clock)})["v"]
        np.testing.assert_allclose(found.values, v, rtol=1e-9)


def test_a_candidates_prediction_and_the_joints_of_a_pendulum(tmp_path):
    folder = tmp_path / "p"
    grounded("init", folder, "--example", "pendulum")
    grounded("-C", folder, "propose")
    words = ("c0001", "--format", "bag", "-o", tmp_path / "b")
    assert grounded("-C", folder, "export", *words).code == 0
    with AnyReader([tmp_path / "b"]) as bag:
        joints = [
            bag.deserialize(raw, c.msgtype)
            for c, _, raw in bag.messages()
            if c.topic == "/joint_states"
        ]
    assert joints[0].name == ["theta"] and len(joints) == Workspace(folder).task.horizon + 1
    for wrong in (words, ["t0009"]):
        done = grounded("-C", folder, "export", *wrong)
        assert done.code == 1 and done.err.startswith("error: ")


def test_layouts_name_what_is_in_the_files(car, tmp_path):
    model = Workspace(car).base_model
    foxglove, plotjuggler = write_layouts(tmp_path, model)
    layout = json.loads(foxglove.read_text())
    plotted = {p["value"] for c in layout["configById"].values() for p in c.get("paths", [])}
    curves = {one.attrib["name"] for one in ElementTree.parse(plotjuggler).iter("curve")}
    assert {path.replace(".", "/") for path in plotted} == curves
    files = [*(car / "trials").glob("t0001*.mcap"), car / "candidates/c0001.mcap"]
    there = {f.path for file in files for t in inspect_log(file).topics for f in t.fields}
    assert plotted <= there
    placed = json.dumps(layout["layout"])
    assert all(name in placed for name in layout["configById"])
