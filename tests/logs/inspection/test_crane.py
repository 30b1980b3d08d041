"""A crane's log: a trolley and a load that swings, each a position with its rate."""

import pytest

from grounded_trials.starting.begin import begin
from ros_bags import crane_bag

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
    """By names and units where they say it, by the model's steps where they don't."""
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
