"""Logs without the robot's commands, or with another topic than [log] names."""

import numpy as np
import pytest

from grounded.errors import GroundedError
from grounded_trials import Workspace
from grounded_trials.starting.begin import begin
from ros_bags import START, T, bag, joints

MODEL = """import grounded as gr

model = gr.Model(
    states={"boom": "rad", "stick": "rad", "boom_rate": "rad/s", "stick_rate": "rad/s"},
    inputs={"boom_valve": "1", "stick_valve": "1"},
    params={"k": gr.Param(0.6, "rad/s", 0.3, 1.2)},
    derivative=lambda s, a, p: {
        "boom": s.boom_rate,
        "stick": s.stick_rate,
        "boom_rate": 7 * (p.k * a.boom_valve - s.boom_rate),
        "stick_rate": 7 * (p.k * a.stick_valve - s.stick_rate),
    },
)
"""
COMMANDS = "/valve_controller/commands"
NAMES = ["boom_joint", "stick_joint"]


def excavator(folder, commands=True):
    """An arm of two joints for 6 s; its commands may be missing."""
    topic = "/joint_states"
    topics = {topic: "sensor_msgs/msg/JointState", COMMANDS: "std_msgs/msg/Float64MultiArray"}
    layout = T["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)

    def messages():
        q, w = np.array([0.3, -1.2]), np.zeros(2)
        for k in range(600):
            t = START + k * 10**7
            u = 0.5 * np.sin(np.array([0.02, 0.031]) * k)
            yield topic, t, joints(t, NAMES, q, w, np.zeros(2))
            if commands and k % 2 == 0:
                yield COMMANDS, t, T[topics[COMMANDS]](layout=layout, data=u)
            w = w + 0.07 * (0.6 * u - w)
            q = q + 0.01 * w

    return bag(folder, topics, messages())


@pytest.fixture
def model(tmp_path):
    (tmp_path / "own.py").write_text(MODEL)
    return tmp_path / "own.py"


def test_joint_positions_are_no_commands_if_these_were_not_recorded(tmp_path, model):
    log = excavator(tmp_path / "bag", commands=False)
    begun = begin(tmp_path / "w", log, model=model)
    assert [s.path for s in begun.states][:2] == [f"/joint_states.position[{i}]" for i in (0, 1)]
    assert [guess.path for guess in begun.inputs] == ["", ""]
    assert not any(one.sure or "joint_states" in str(one.others) for one in begun.inputs)
    assert all(one.reasons[-1].about == (COMMANDS,) for one in begun.inputs)
    assert begun.then.verb == "inspect"


def test_ingest_refuses_an_input_on_the_path_of_a_state(tmp_path, model):
    begin(tmp_path / "w", log := excavator(tmp_path / "bag"), model=model)
    toml = tmp_path / "w" / "grounded.toml"
    toml.write_text(toml.read_text().replace(f"{COMMANDS}.data[0]", "/joint_states.position[0]"))
    with pytest.raises(GroundedError, match=r"state\.boom\].*input\.boom_valve\]"):
        Workspace(tmp_path / "w").ingest(log, data=True)
