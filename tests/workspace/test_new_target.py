"""Replacing a target from Python: columns are checked before a file is written."""

import numpy as np
import pytest

from cli import grounded
from facts import holding
from grounded.errors import GroundedError
from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.store.trial_file import write_trial
from grounded_trials.workspace import new_target
from workspaces import blank, edit

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


def test_the_old_target_is_kept(w):
    old = (w.folder / "target.csv").read_bytes()
    path = w.target({"theta": list(LINE)})
    assert (w.folder / "target.csv.bak").read_bytes() == old != path.read_bytes()
    assert w.config.task.horizon == 20


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


@pytest.mark.parametrize(("end", "told"), [(1.5, False), (90.0, True)])
def test_a_table_in_degrees_is_told(w, tmp_path, end, told):
    rows = "".join(f"{0.02 * k:.2f},{end * k / 100}\n" for k in range(101))
    (table := tmp_path / "mine.csv").write_text("t,theta\n" + rows)
    done = grounded("-C", w.folder, "target", table, "--json").json
    assert ("start.degrees" in {one["code"] for one in done["findings"]}) == told
