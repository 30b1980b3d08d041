"""export --library and init --actuators: an actuator that another workspace begins with."""

from __future__ import annotations

import pytest

from cli import grounded
from grounded_trials import Workspace
from workspaces import make

FOUND = """effects = [
    { name = "coulomb_friction:v", c = 0.3, width = 0.01 },
    { name = "delay:force", d = 0.04 },
    { name = "dead_zone:force", c = 0.1 },
]

[task]"""


def test_another_workspace_begins_with_an_actuator_and_its_spread(tmp_path):
    w = make(tmp_path / "w").folder
    toml = w / "grounded.toml"
    text = toml.read_text("utf-8").replace("[task]", FOUND, 1)
    toml.write_text(
        text.replace('file = "model.py"', 'file = "model.py"\nparams = { mass = 2.0 }'), "utf-8"
    )
    file = tmp_path / "motor.yaml"
    done = grounded("-C", w, "export", "--library", file, "--json")
    values = {key: one["value"] for key, one in done.json["values"].items()}
    assert values == pytest.approx({"dry_friction": 0.6, "delay": 0.04, "dead_zone": 0.1})  # c M
    text = file.read_text("utf-8")
    assert "actuator: force" in text and "source:" in text
    file.write_text(text.replace("{value: 0.1,", "{value: 0.1, std: 0.02,"), "utf-8")

    args = ("init", tmp_path / "n", "--blank", "--model", w / "model.py", "--actuators", file)
    assert grounded(*args).code == 0
    new = Workspace(tmp_path / "n")
    effects = {str(e["name"]): e for e in new.config.model.effects}
    assert effects["joint_friction:force<-v"]["c"] == pytest.approx(0.6)
    assert effects["delay:force"]["d"] == pytest.approx(0.04)
    params = new.planner.plan.model.params
    assert params["dead_zone_force_c"].value == pytest.approx(0.1)
    assert params["dead_zone_force_c"].std == pytest.approx(0.02)


def test_what_is_not_known_is_refused(tmp_path):
    w = make(tmp_path / "w").folder
    refused = grounded("-C", w, "export", "--library", tmp_path / "x.yaml")
    assert refused.code == 1 and not (tmp_path / "x.yaml").exists()
    (tmp_path / "x.yaml").write_text("mass: 1\n", "utf-8")
    args = ("init", tmp_path / "n", "--blank", "--model", w / "model.py")
    assert grounded(*args, "--actuators", tmp_path / "x.yaml").code == 1
