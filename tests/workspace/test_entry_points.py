"""Models, effects and actuators that come by name or from another workspace."""

from __future__ import annotations

import importlib
import pkgutil
import tomllib
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cli import grounded
from facts import holding
from grounded import Model
from grounded import models as ours
from grounded.effects import Library
from grounded.errors import GroundedError
from grounded_trials import Workspace
from grounded_trials.workspace.user_files.model_file import load_module, model_in
from workspaces import CONFIG, make

ROOT = Path(__file__).resolve().parents[2]
GROUP = "grounded.models"


def declared():
    """The entry points as pyproject.toml has them."""
    table = tomllib.loads((ROOT / "pyproject.toml").read_text())
    points = table["project"]["entry-points"][GROUP]
    return [EntryPoint(name, value, GROUP) for name, value in points.items()]


def test_every_model_of_the_package_has_an_entry_point():
    modules = [m.name for m in pkgutil.iter_modules(ours.__path__)]
    with_model = {
        name
        for name in modules
        if isinstance(getattr(importlib.import_module(f"{GROUP}.{name}"), "model", None), Model)
    }
    assert with_model == {point.name for point in declared()} != set()
    assert all(isinstance(point.load(), Model) for point in declared())


@pytest.fixture
def registered(monkeypatch):
    points = [*declared(), EntryPoint("boat", "grounded.models.car:model", GROUP)]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: points)


@pytest.mark.parametrize("name", ["aircraft", "pendulum", "boat", "grounded.models.pendulum"])
def test_a_model_is_loaded_by_its_name_or_its_module(registered, tmp_path, name):
    assert isinstance(model_in(load_module(tmp_path, module=name)), Model)


def test_an_unknown_module_names_the_models_there_are(registered, tmp_path):
    with pytest.raises(GroundedError, match=holding("'boot'", "'boat'")):
        load_module(tmp_path, module="boot")


def test_a_workspace_takes_a_registered_model(registered, tmp_path):
    config = CONFIG.replace('file = "model.py"', 'module = "pendulum"')
    assert make(tmp_path / "w", config=config).base_model.state_names == ("theta", "omega")


def test_a_guests_effect_is_planned_with_once_it_is_adopted(monkeypatch, tmp_path):
    guest = replace(Library().family("viscous_friction"), name="eddy_brake")
    point = SimpleNamespace(value="guest:eddy_brake", load=lambda: guest)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [point])

    def step(name):
        effect = f'\n[[model.effects]]\nname = "{name}:v"\nk = 0.7\n'
        model = make(tmp_path / name, config=CONFIG + effect).planner.plan.model
        x, u = np.ones((1, model.n)), np.ones((1, model.m))
        return model.system.step(x, u, model.values, 0.1)

    np.testing.assert_array_equal(step("eddy_brake"), step("viscous_friction"))


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
