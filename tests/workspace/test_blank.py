"""A workspace from a model alone, the robot's program, and another target from Python."""

import importlib.util
import re
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from cli import grounded
from facts import holding, of_code
from grounded.errors import GroundedError, NextCommand
from grounded.policy import load
from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.store.trial_file import write_trial
from grounded_trials.workspace import new_target
from workspaces import blank, edit

ROOT = Path(__file__).resolve().parents[2]
MODEL = """
from grounded import Model, Param

def rate(s, a, p):
    return {"x": s.v, "v": (a.force - p.c * s.v) / p.M}

model = Model(name="sled", states={"x": "m", "v": "m/s"}, inputs={"force": "N"},
              params={"M": Param(1.0, "kg", 0.5, 2.0), "c": Param(0.3, "1", 0.0, 1.0)},
              derivative=rate)
"""


@pytest.fixture(autouse=True)
def installed(monkeypatch):
    """The entry points as pyproject.toml declares them, installed or not."""
    points = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]

    def found(group):
        return [EntryPoint(name, value, group) for name, value in points.get(group, {}).items()]

    monkeypatch.setattr("importlib.metadata.entry_points", found)


@pytest.fixture
def sled(tmp_path):
    return blank(tmp_path / "w", MODEL)


def driver(folder):
    spec = importlib.util.spec_from_file_location("drive", folder / "drive.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_blank_workspace_goes_from_a_model_to_an_accepted_trial(sled, tmp_path, monkeypatch):
    edit(sled.folder, limits="force = [-50, 50]")
    proposed = sled.propose()
    drive = driver(sled.folder)
    state, sent = np.array([0.0, 0.0]), []  # target.csv says where it starts
    monkeypatch.setattr(drive.time, "sleep", lambda seconds: None)

    def send(u):
        sent.append(float(u[0]))
        state[:] += 0.05 * np.array([state[1], u[0] - 0.5 * state[1]])

    monkeypatch.setattr(drive, "measure", lambda: state.copy())
    monkeypatch.setattr(drive, "send", send)
    drive.main(str(proposed.file), str(tmp_path / "run.mcap"))
    assert len(sent) == 101
    taken = sled.ingest(tmp_path / "run.mcap")
    assert taken.candidate == "c0001"
    assert sled.status().standing.incumbent.candidate.id == "c0001"


def test_run_comes_next_only_once_the_program_was_completed(sled):
    """Somebody who exports candidates and ingests logs was told to `run` an empty skeleton."""
    edit(sled.folder, limits="force = [-50, 50]")
    drive = sled.folder / "drive.py"
    assert (sled.propose().then.verb, sled.status().then.verb) == ("export", "export")
    sled.export("c0001", sled.folder / "c0001.npz")
    assert sled.status().then == NextCommand("next", ("LOG",))
    drive.write_text(re.sub("raise SystemExit.*", "return [0.0, 0.0]", drive.read_text()))
    assert (sled.propose().then.verb, sled.status().then.verb) == ("run", "run")


def test_the_first_plan_says_what_the_task_leaves_open(sled):
    told = sled.propose()
    assert [one.about for one in of_code(told, "plan.no_limits")] == [("force",)]


BOAT = """from grounded import Model, Param

def rate(s, a, p):
    return {"u": a.thrust - s.u, "r": p.k * s.u * a.rudder - s.r}

model = Model(states={"u": "m/s", "r": "rad/s"}, inputs={"rudder": "1", "thrust": "1"},
              params={"k": Param(1.0, "rad/m/s")}, derivative=rate)
"""


@pytest.mark.parametrize(("k", "idle"), [("1.0", []), ("0.0", [("rudder",)])])
def test_an_input_that_acts_only_in_motion_has_an_effect(tmp_path, k, idle):
    w = blank(tmp_path / "w", BOAT.replace("Param(1.0", f"Param({k}"))
    assert [one.about for one in of_code(w.propose(), "plan.without_effect")] == idle


HOVER = """from grounded import Model, Param

def rate(s, a, p):
    lift = p.k * (a.left * a.left + a.right * a.right) / p.m
    return {"z": s.v, "v": lift - 9.81, "w": a.left - a.right}

model = Model(states={"z": "m", "v": "m/s", "w": "rad/s"}, inputs={"left": "1", "right": "1"},
              params={"k": Param(8.0, "N"), "m": Param(1.2, "kg")}, derivative=rate)
"""


def test_what_holds_the_start_is_held_before_it(tmp_path):
    w = blank(tmp_path / "w", HOVER)
    hover = (1.2 * 9.81 / 16) ** 0.5
    assert list(w.config.task.start) == ["left", "right"]
    np.testing.assert_allclose(w.task.past, hover, rtol=1e-5)


def test_a_candidate_as_proposed_runs_like_its_export(sled, tmp_path):
    edit(sled.folder, limits="force = [-50, 50]")
    candidate = sled.propose()
    as_proposed = load(candidate.file, states=("x", "v"), inputs=("force",))
    as_exported = load(sled.export("c0001", tmp_path / "c0001.npz").file)
    for t, s in ((0.0, [1.0, 0.2]), (0.05, [0.9, 0.1]), (99.0, [0.0, 0.0])):
        np.testing.assert_array_equal(as_proposed.action(t, s), as_exported.action(t, s))
    with pytest.raises(GroundedError, match=holding("('x', 'v')", "('v', 'x')")):
        load(candidate.file, states=("v", "x"))
    with pytest.raises(GroundedError, match=holding("0" * 16)):
        load(candidate.file, task="0" * 16)


def test_nothing_is_overwritten(sled):
    before = (sled.folder / "drive.py").read_bytes()
    with pytest.raises(GroundedError, match="exists already"):
        Workspace.create(sled.folder, model=sled.folder / "model.py")
    assert (sled.folder / "drive.py").read_bytes() == before


def test_a_model_that_needs_its_neighbours_leaves_nothing_behind(tmp_path):
    (tmp_path / "masses.csv").write_text("1.0\n")
    (tmp_path / "sled.py").write_text(
        "from pathlib import Path\n(Path(__file__).parent / 'masses.csv').read_text()\n" + MODEL
    )
    with pytest.raises(GroundedError) as refused:
        Workspace.create(tmp_path / "w", model=tmp_path / "sled.py")
    assert "masses.csv" in str(refused.value) and str(tmp_path / "w") in str(refused.value)
    assert not (tmp_path / "w").exists()
    (tmp_path / "w").mkdir()
    (tmp_path / "w" / "masses.csv").write_text("1.0\n")
    (tmp_path / "w" / "model.py").write_text((tmp_path / "sled.py").read_text())
    made = Workspace.create(tmp_path / "w", model=tmp_path / "w" / "model.py")
    assert (made.folder / "drive.py").is_file()


LINE = np.linspace(0, 1, 21)


@pytest.fixture
def w(tmp_path):
    return Workspace.create(tmp_path / "w", example="pendulum")


def files(w):
    return {p.name: p.read_bytes() for p in w.folder.iterdir() if p.is_file()}


@pytest.mark.parametrize(
    ("columns", "facts"),
    [
        ({"y": LINE}, ("'y'", "state")),
        ({"torque": LINE}, ("'torque'",)),
        ({"theta": LINE, "omega": LINE[1:]}, ("'theta': 21", "'omega': 20")),
        ({"theta": np.where(LINE == 0.5, np.nan, LINE)}, ("'theta'", "nan", "row 10")),
        ({"theta": 1.0}, ("'theta'", "()")),
        ({"theta": LINE[:, None]}, ("'theta'", "(21, 1)")),
        ({"theta": "line"}, ("'theta'", "'line'")),
        ({}, ("dict",)),
        ("target.csv", ("dict", "'target.csv'")),
        ({"theta": LINE[:1]}, ("2", "1")),
    ],
)
def test_columns_that_are_no_target_change_no_file(w, columns, facts):
    before = files(w)
    with pytest.raises(GroundedError, match=holding(*facts)):
        w.target(columns)
    assert files(w) == before


def test_the_old_target_is_back_if_the_settings_can_t_be_written(w, monkeypatch):
    def full(*_):
        raise GroundedError("the disk is full")

    before = (w.folder / "target.csv").read_bytes()
    monkeypatch.setattr(new_target, "set_target", full)
    with pytest.raises(GroundedError, match="full"):
        w.target({"theta": LINE})
    assert (w.folder / "target.csv").read_bytes() == before


def test_the_settings_are_as_before_if_the_target_can_t_be_written(w):
    (w.folder / "target.csv").unlink()
    (w.folder / "target.csv").mkdir()
    before = files(w)
    with pytest.raises(GroundedError, match=r"target\.csv"):
        w.target({"theta": LINE})
    assert files(w) == before


PLATE = """from grounded import Model
model = Model(states={"T": "degC", "x": "m"}, inputs={"heater": "%"}, params={},
    derivative=lambda s, a, p: {"T": 0.01 * a.heater - 0.01 * (s.T - 20), "x": 0.01 * a.heater})
"""


@pytest.mark.parametrize(
    ("given", "first", "start"),
    [("{ }", 23.0, 23.0), ("{ T = 30.0 }", 23.0, 30.0), ("{ }", 0.0, 0.0)],
)
def test_a_step_begins_where_the_trials_rest_if_nobody_said_where(tmp_path, given, first, start):
    w = blank(tmp_path / "w", PLATE, dt=2.0, start=given, limits="heater = [0, 100]")
    warm = np.concatenate([np.full(9, first), first + np.linspace(0, 20, 32)])
    states = np.column_stack([warm, np.full(41, 3.0)])
    heat = np.where(np.arange(40) < 8, 0.0, 60.0)[:, None]
    trial = Trial(states, heat, 2.0, ("T", "x"), ("heater",))
    write_trial(tmp_path / "a.mcap", trial, {"kind": "data"})
    w.ingest(tmp_path / "a.mcap", data=True)
    assert grounded("-C", w.folder, "target", "step", "--to", "T=45", "--seconds", "60").code == 0
    w = Workspace(w.folder)
    assert w.config.task.start == ({"T": start} if start else {})  # x may be anywhere
    assert (w.task.start[0], w.task.target[0, 0], w.task.target[-1, 0]) == (start, start, 45.0)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"state": "{ theta = -1.0 }"}, "[reward] state"),
        ({"limits": "tork = [-1, 1]"}, "[limits] tork"),
    ],
)
def test_a_broken_grounded_toml_is_told_before_a_target_is_written(w, change, named):
    edit(w.folder, **change)
    before = files(w)
    with pytest.raises(GroundedError, match=holding(named)):
        w.target({"theta": LINE})
    assert files(w) == before
