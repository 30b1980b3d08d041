"""Models and effects that come by name: those of this package use the door that guests use."""

import importlib
import pkgutil
import tomllib
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import grounded.models
from facts import holding
from grounded import Model
from grounded.effects import Library
from grounded.errors import GroundedError
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
    modules = [m.name for m in pkgutil.iter_modules(grounded.models.__path__)]
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
