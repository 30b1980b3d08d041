"""Models and effects by name, and the model as it is now, in the form that it came in."""

from __future__ import annotations

import difflib
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
from grounded.adapters import mujoco
from grounded.effects import Library
from grounded.errors import GroundedError
from grounded.policy import Policy
from grounded.rollout import simulate
from grounded_trials import Workspace
from grounded_trials.workspace.user_files.model_file import load_module, model_in
from workspaces import CONFIG, make

mj = pytest.importorskip("mujoco")


ARM = """<?xml version="1.0"?>
<!-- two links, ä -->
<mujoco model="arm">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <default>
    <joint damping="0.02"/>
    <default class="big"><joint armature="0.001"/></default>
  </default>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <body name="fore" pos="0 0 -0.3">
        <joint name="elbow"   axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.02" mass="0.3"/>
      </body>
      <joint name='shoulder' axis="0 1 0" class="big" />
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" mass="0.6"/>
    </body>
  </worldbody>
  {actuators}
</mujoco>
"""


ACTUATORS = """<actuator>
    <motor name="m1" joint="shoulder" gear="2"/>
    <motor name="m2" joint="elbow"/>
  </actuator>"""


MODEL = """from grounded.adapters import mujoco

model = mujoco.model("arm.xml", params={"fore.mass": (0.1, 1.0), "elbow.damping": (0, 1)})
"""


FOUND = """params = { fore_mass = 0.35, elbow_damping = 0.05 }
effects = [
    { name = "joint_friction:m1<-shoulder_vel", c = 0.1, b = 0.03, width = 0.01 },
    { name = "added_inertia:m2<-elbow_vel", J = 0.004 },
    { name = "delay:m1+m2", d = 0.03 },
    { name = "first_order_lag:m1", tau = 0.05 },
    EFFECT
]

[task]"""


WANTED = {
    "fore.mass": 0.35,
    "elbow.damping": 0.05,
    "shoulder.frictionloss": 0.2,
    "shoulder.damping": 0.08,
    "elbow.armature": 0.004,
    "m1.delay": 0.03,
    "m2.delay": 0.03,
    "m1.lag": 0.05,
}


def adopted(folder: Path, files: dict[str, str], effect: str = "", found: str = FOUND) -> Workspace:
    """A workspace of an arm with parameters and effects in its grounded.toml."""
    folder.mkdir()
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    w = Workspace.create(folder / "w", model=folder / "model.py")
    toml = w.folder / "grounded.toml"
    found = found.replace("EFFECT", effect)
    toml.write_text(toml.read_text("utf-8").replace("[task]", found, 1), encoding="utf-8")
    return Workspace(w.folder)


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    files = {"arm.xml": ARM.replace("{actuators}", ACTUATORS), "model.py": MODEL}
    effect = '{ name = "dead_zone:m2", c = 0.02 },'
    return adopted(tmp_path_factory.mktemp("arm") / "a", files, effect)


def test_the_file_has_the_values_and_the_rest_of_it_to_the_byte(arm, tmp_path):
    done = arm.export_model(tmp_path / "found.xml")
    assert {name: one.value for name, one in done.values.items()} == pytest.approx(WANTED)
    before = done.source.read_bytes().splitlines()
    after = done.file.read_bytes().splitlines()
    old = [
        line[2:]
        for line in difflib.ndiff([*map(repr, before)], [*map(repr, after)])
        if line[0] == "-"
    ]
    assert len(old) == 4  # the lines of two joints and two actuators, nothing else
    compiled = mj.MjModel.from_xml_path(str(done.file))
    assert compiled.dof_damping[compiled.joint("shoulder").dofadr[0]] == pytest.approx(0.08)
    assert compiled.dof_armature == pytest.approx([0.001, 0.004])  # that of the class stays
    assert compiled.actuator_delay == pytest.approx([0.03, 0.03])


def test_what_the_format_can_not_hold_is_told_with_its_equation(arm, tmp_path):
    done = grounded("-C", arm.folder, "export", "--model", "-o", tmp_path / "x.xml", "--json").json
    (lost,) = [one for one in done["findings"] if "equation" in one["facts"]]
    assert lost["about"] == ["dead_zone:m2"] and "sign(u)" in lost["facts"]["equation"]
    assert lost["facts"]["equation"] in (tmp_path / "x.xml").read_text("utf-8")


def test_the_users_own_file_is_never_overwritten(arm, tmp_path):
    for path in (arm.folder / "arm.xml", tmp_path / "arm.urdf"):
        with pytest.raises(GroundedError) as error:
            arm.export_model(path)
        assert error.value.finding.code == "model.other_form"


def test_an_included_file_that_changes_is_written_beside(tmp_path):
    files = {
        "arm.xml": ARM.replace("{actuators}", '<include file="motors.xml"/>'),
        "motors.xml": f"<mujocoinclude>{ACTUATORS}</mujocoinclude>",
        "model.py": MODEL,
    }
    w = adopted(tmp_path / "a", files)
    done = w.export_model(w.folder / "found.xml")
    assert {name: one.value for name, one in done.values.items()} == pytest.approx(WANTED)
    assert (w.folder / "motors.xml").read_text("utf-8") == files["motors.xml"]
    assert [path.parent for path in done.others] == [w.folder]
    assert mj.MjModel.from_xml_path(str(done.file)).actuator_delay == pytest.approx([0.03, 0.03])


def test_mujoco_with_the_file_moves_as_the_model_predicts(tmp_path):
    files = {"arm.xml": ARM.replace("{actuators}", ACTUATORS), "model.py": MODEL}
    w = adopted(tmp_path / "a", files)
    done, plan = w.export_model(tmp_path / "found.xml"), w.planner.plan
    steps = np.arange(plan.horizon)
    u = np.stack([0.8 * np.sin(0.2 * steps), 0.3 * np.cos(0.35 * steps)], axis=1)
    wide, n = np.full(2, np.inf), plan.model.n
    policy = Policy(
        feedforward=u,
        low=-wide,
        high=wide,
        dt=plan.dt,
        state_names=plan.model.state_names,
        input_names=plan.model.input_names,
        depths=(1, 1),
        angles=(False,) * n,
        past=np.zeros(2),
    )
    ahead = simulate(plan.problem(exact=True), w.planner.widened(policy)).states[:, :4]
    model = mj.MjModel.from_xml_path(str(done.file))
    data, path = mj.MjData(model), []
    for now in u:
        path.append(np.concatenate([data.qpos, data.qvel]))
        data.ctrl[:] = now
        mj.mj_step(model, data, round(plan.dt / model.opt.timestep))
    off = np.abs(np.array(path) - ahead[:-1])[:30, :2].max(axis=0)
    assert (off < 0.1 * np.std(path[:30], axis=0)[:2]).all()


def test_a_model_py_keeps_all_but_its_numbers(tmp_path):
    w = make(tmp_path / "w")
    toml = w.folder / "grounded.toml"
    text = toml.read_text("utf-8").replace("[task]", "params = { mass = 1.4 }\n\n[task]", 1)
    toml.write_text(text, encoding="utf-8")
    done = Workspace(w.folder).export_model(tmp_path / "found.py")
    own = [
        line for line in done.file.read_text("utf-8").splitlines(keepends=True) if line[0] != "#"
    ]
    before = (w.folder / "model.py").read_text("utf-8")
    assert "".join(own) == before.replace("Param(1.0,", "Param(1.4,")


URDF = """<robot name="arm">
  <link name="base"/>
  <link name="fore">
    <inertial>
      <origin xyz="0 0 -0.1"/>
      <mass value="0.3"/>
      <inertia ixx="0.002" ixy="0" ixz="0" iyy="0.002" iyz="0" izz="0.0001"/>
    </inertial>
  </link>
  <joint name="elbow" type="continuous">
    <parent link="base"/> <child link="fore"/>
    <axis xyz="0 1 0"/>
  </joint>
</robot>
"""


def test_a_urdf_has_masses_damping_and_friction_and_no_armature(tmp_path):
    fields = 'params={"fore.mass": (0.1, 1.0), "elbow.damping": (0, 1), "elbow.armature": (0, 1)}'
    own = MODEL.replace("arm.xml", "arm.urdf")
    own = own[: own.index("params")] + fields + ")\n"
    found = """params = { fore_mass = 0.6, elbow_damping = 0.05, elbow_armature = 0.01 }
effects = [ { name = "coulomb_friction:elbow_vel", c = 2.0, width = 0.01 } ]

[task]"""
    w = adopted(tmp_path / "a", {"arm.urdf": URDF, "model.py": own}, found=found)
    done = w.export_model(tmp_path / "found.urdf")
    assert [(one.code, one.about) for one in done.findings] == [
        ("model.no_place", ("elbow.armature",))
    ]
    compiled = mj.MjModel.from_xml_path(str(done.file))
    assert compiled.body_mass[-1] == pytest.approx(0.6)
    assert compiled.dof_damping == pytest.approx([0.05])
    M = 0.004 + 0.6 * 0.1**2 + 0.01  # kg m^2, about the joint
    assert compiled.dof_frictionloss == pytest.approx([2.0 * M])


def test_a_delay_of_the_file_is_the_task_s_latency(tmp_path):
    late = ACTUATORS.replace('gear="2"', 'gear="2" delay="0.03" nsample="20"')
    (tmp_path / "arm.xml").write_text(ARM.replace("{actuators}", late), encoding="utf-8")
    w = Workspace.create(tmp_path / "w", model=tmp_path / "arm.xml")
    assert w.config.task.latency == {"m1": 0.03}
    # the model's own step has no delay, and the file keeps what it has
    plain = mujoco.model(ARM.replace("{actuators}", ACTUATORS))
    x, u = np.full((1, plain.n), 0.1), np.full((1, plain.m), 0.2)
    after = [m.system.step(x, u, m.values, 0.02) for m in (w.base_model, plain)]
    np.testing.assert_array_equal(*after)
    assert w.export_model(tmp_path / "again.xml").values == {}


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


NAMED = """effects = [
    { name = "coulomb_friction:v", c = 0.3, width = 0.01 },
    { name = "delay:force", d = 0.04 },
    { name = "dead_zone:force", c = 0.1 },
]

[task]"""


def test_another_workspace_begins_with_an_actuator_and_its_spread(tmp_path):
    w = make(tmp_path / "w").folder
    toml = w / "grounded.toml"
    text = toml.read_text("utf-8").replace("[task]", NAMED, 1)
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
    effects = new.config.model.effects
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
