"""diagnose --compare of two models: which one to trust, where, and which numbers stay open."""

from __future__ import annotations

import numpy as np
import pytest

from cli import grounded
from grounded.errors import GroundedError
from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.store.trial_file import write_trial
from workspaces import MODEL, make

DT, STEPS = 0.05, 80


@pytest.fixture(scope="module")
def cart(tmp_path_factory):
    """A workspace with four logged runs of a cart of 1.4 kg with a drag of 0.5 N s/m."""
    w = make(tmp_path_factory.mktemp("cart") / "w")
    rng = np.random.default_rng(1)
    for k in range(4):
        t = DT * np.arange(STEPS + 1)
        u = 2 * np.sin((1 + k) * t) + rng.uniform(-1, 1) * np.sign(np.sin(2 * t + k))
        x, v, rows = 0.0, 0.0, []
        for i in range(STEPS + 1):
            noise = rng.normal(size=2) * (1e-3, 5e-3)
            rows.append([t[i], x + noise[0], v + noise[1], u[i]])
            for _ in range(20):
                x, v = x + v * DT / 20, v + (u[i] - 0.5 * v) / 1.4 * DT / 20
        _, *states, force = np.array(rows).T
        trial = Trial(np.stack(states, axis=1), force[:-1, None], DT, ("x", "v"), ("force",))
        write_trial(w.folder / f"run{k}.mcap", trial, {"kind": "trial"})
        Workspace(w.folder).ingest(w.folder / f"run{k}.mcap", data=True)
    return Workspace(w.folder)


def yaml(folder, name, **values):
    path = folder / f"{name}.yaml"
    path.write_text("".join(f"{key}: {value}\n" for key, value in values.items()), "utf-8")
    return path


def test_the_right_model_is_trusted_and_its_numbers(cart, tmp_path):
    right = yaml(tmp_path, "right", mass=1.4, drag=0.5)
    wrong = yaml(tmp_path, "wrong", mass=1.1, drag="{value: 0.9, std: 0.1}")
    found = cart.compare(wrong, right)
    assert found.better == str(right)
    assert {n: one.better for n, one in found.where.items()} == {"x": str(right), "v": str(right)}
    assert {name: one.better for name, one in found.numbers.items()} == dict.fromkeys(
        ("mass", "drag"), str(right)
    )
    assert cart.compare(right, wrong).better == str(right)


def test_what_the_trials_can_not_decide(cart, tmp_path):
    one = yaml(tmp_path, "one", mass=1.4, drag=0.5)
    other = yaml(tmp_path, "other", mass=1.4, drag=0.5004)
    found = cart.compare(one, other)
    assert not found.better
    assert {n: one.better for n, one in found.numbers.items()} == {"drag": None}
    assert [f.code for f in found.findings] == ["gap.undecided"] * 2


def test_a_model_py_and_an_effect(cart, tmp_path):
    (tmp_path / "model.py").write_text(MODEL.replace("Param(1.0,", "Param(1.4,"), "utf-8")
    table = "mass: 1.4\ndrag: 0.2\neffects: {'viscous_friction:v': {k: 0.214}}\n"
    (tmp_path / "more.yaml").write_text(table, "utf-8")
    done = grounded(
        *(
            "-C",
            cart.folder,
            "diagnose",
            "--compare",
            tmp_path / "model.py",
            tmp_path / "more.yaml",
        ),
        "--json",
    )
    assert done.json["better"] == str(tmp_path / "more.yaml"), done.err
    assert done.json["numbers"]["viscous_friction:v"]["better"] == str(tmp_path / "more.yaml")


@pytest.mark.parametrize(
    ("text", "code"),
    [("mass: [1, 2]", "given.value"), ("a: b: c", "file.unreadable"), ("3", "given.value")],
)
def test_a_file_that_is_no_model(cart, tmp_path, text, code):
    (tmp_path / "x.yaml").write_text(text, "utf-8")
    with pytest.raises(GroundedError) as error:
        cart.compare(".", tmp_path / "x.yaml")
    assert error.value.finding.code == code


POLE = """<mujoco>
  <option timestep="0.01"/>
  <worldbody><body name="pole"><joint name="hinge" axis="0 1 0" damping="{damping}"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="{mass}"/></body></worldbody>
  <actuator><motor name="motor" joint="hinge" {delay}/></actuator>
</mujoco>"""


def test_two_mjcf_files_of_which_one_has_a_delay(tmp_path):
    mj = pytest.importorskip("mujoco")
    late = 'delay="0.06" nsample="7"'
    for name, values in {
        "pole.xml": {"damping": 0.05, "mass": 0.4, "delay": ""},
        "one.xml": {"damping": 0.1, "mass": 0.4, "delay": late},
        "other.xml": {"damping": 0.05, "mass": 0.4, "delay": ""},
    }.items():
        (tmp_path / name).write_text(POLE.format(**values), "utf-8")
    w = Workspace.create(tmp_path / "w", model=tmp_path / "pole.xml")
    rng, t = np.random.default_rng(2), DT * np.arange(STEPS)
    robot = mj.MjModel.from_xml_path(str(tmp_path / "one.xml"))
    for k in range(3):
        data, rows, u = mj.MjData(robot), [], 0.4 * np.sin((2 + k) * t) * np.sign(np.sin(9 * t))
        for now in (*u, 0.0):
            rows.append([data.qpos[0], data.qvel[0]] + rng.normal(size=2) * (5e-4, 5e-3))
            data.ctrl[0] = now
            mj.mj_step(robot, data, 5)
        trial = Trial(np.array(rows), u[:, None], DT, ("hinge", "hinge_vel"), ("motor",))
        write_trial(tmp_path / f"{k}.mcap", trial, {"kind": "trial"})
        w.ingest(tmp_path / f"{k}.mcap", data=True)
    right = str(tmp_path / "one.xml")
    found = w.compare(right, tmp_path / "other.xml")
    assert found.better == right
    better = {name: one.better for name, one in found.numbers.items()}
    assert better == {"latency:motor": right, "hinge_damping": right}
    assert w.compare(".", tmp_path / "other.xml").better is None


def test_fitted_values_are_taken_home_with_their_spread(cart, tmp_path):
    cart.fit(apply=True)
    done = Workspace(cart.folder).export_model(tmp_path / "found.py")
    values = done.values
    assert abs(values["mass"].value - 1.4) < 4 * values["mass"].std < 0.1
