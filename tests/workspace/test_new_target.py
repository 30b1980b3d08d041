"""Replacing a target from Python: columns are checked before a file is written."""

import numpy as np
import pytest

from cli import grounded
from facts import holding, holds
from grounded.errors import GroundedError
from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.store.trial_file import write_trial
from grounded_trials.workspace import new_target
from grounded_trials.workspace.new_target import refuse_degrees
from small_tasks import rover

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
        ({"theta": LINE, "omega": LINE[1:]}, ("theta 21", "omega 20")),
        ({"theta": np.where(LINE == 0.5, np.nan, LINE)}, ("'theta'", "nan", "row 10")),
        ({"theta": 1.0}, ("'theta'", "()")),
        ({"theta": LINE[:, None]}, ("'theta'", "(21, 1)")),
        ({"theta": "line"}, ("'theta'", "'line'")),
        ({}, ("none",)),
        ("target.csv", ("str",)),
        ({"theta": LINE[:1]}, ("2", "got 1")),
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


def test_the_old_target_is_kept(w):
    old = (w.folder / "target.csv").read_bytes()
    path = w.target({"theta": list(LINE)})
    assert (w.folder / "target.csv.bak").read_bytes() == old != path.read_bytes()
    assert w.config.task.horizon == 20


CART = """
from grounded import Model

model = Model(states={"x": "mm", "v": "mm/s"}, inputs={"u": "mm/s^2"},
              derivative=lambda s, a, p: {"x": s.v, "v": a.u})
"""


@pytest.mark.parametrize("size", [180.0, 1800.0])
def test_weights_of_large_ranges_are_not_taken_for_chosen_ones(tmp_path, size):
    (tmp_path / "cart.py").write_text(CART)
    w = Workspace.create(tmp_path / "w", model=tmp_path / "cart.py")
    for far in (size, 1.0):
        w.target({"x": far * LINE})
        w.forget()
        assert w.task.reward.state[0] == pytest.approx(far**-2, rel=1e-4)


PLATE = """from grounded import Model
model = Model(states={"T": "degC", "x": "m"}, inputs={"heater": "%"}, params={},
    derivative=lambda s, a, p: {"T": 0.01 * a.heater - 0.01 * (s.T - 20), "x": 0.01 * a.heater})
"""


def plate(folder, first=23.0, x=3.0):
    """A workspace without a start, and a trial in which a plate is heated after a while."""
    home = folder / "w"
    home.mkdir(parents=True)
    (home / "model.py").write_text(PLATE)
    text = (
        '[model]\nfile = "model.py"\n[task]\ndt = 2.0\nhorizon = 20\ntarget = "target.csv"\n'
        "start = {}\n[reward]\nstate = { T = 1.0 }\n[limits]\nheater = [0, 100]\n"
    )
    (home / "grounded.toml").write_text(text)
    rows = "\n".join(f"{2 * k},0.0" for k in range(21))
    (home / "target.csv").write_text(f"t,T\n{rows}\n")
    warm = np.concatenate([np.full(9, first), first + np.linspace(0, 20, 32)])
    states = np.column_stack([warm, np.full(41, x)])
    heat = np.where(np.arange(40) < 8, 0.0, 60.0)[:, None]
    trial = Trial(states, heat, 2.0, ("T", "x"), ("heater",))
    write_trial(folder / "a.mcap", trial, {"kind": "data"})
    Workspace(home).ingest(folder / "a.mcap", data=True)
    return Workspace(home)


def test_a_step_begins_where_the_trials_rest_if_nobody_said_where(tmp_path):
    w = plate(tmp_path)
    done = grounded("-C", w.folder, "target", "step", "--to", "T=45", "--seconds", "60")
    assert holds(" ".join(done.out.split()), "23.00 to 45.00 degC", "t0001 rests: T = 23.00")
    w = Workspace(w.folder)
    assert w.config.task.start == {"T": 23.0}  # x may be anywhere
    assert w.task.start[0] == 23.0
    assert "velocities" not in done.out  # there are none
    again = grounded("-C", w.folder, "target", "step", "--to", "T=50", "--seconds", "60")
    assert "rests" not in again.out and "23.00 to 50.00" in again.out


def test_a_start_that_was_chosen_stays_as_it_is(tmp_path):
    w = plate(tmp_path)
    file = w.folder / "grounded.toml"
    file.write_text(file.read_text().replace("start = {}", "start = { T = 30.0 }"))
    done = grounded("-C", w.folder, "target", "step", "--to", "T=45", "--seconds", "60")
    assert "30.00 to 45.00 degC" in done.out and "rests" not in done.out
    moving = plate(tmp_path / "moving", first=0.0)
    done = grounded("-C", moving.folder, "target", "step", "--to", "T=45", "--seconds", "60")
    assert "0 to 45.00" in done.out and not Workspace(moving.folder).config.task.start


@pytest.mark.parametrize(
    ("table", "named"),
    [
        ("[reward]\nposition = 1.0\n", "[reward] position"),
        ("[reward]\nstate = { theta = -1.0 }\n", "negative"),
        ("[limits]\ntork = [-1, 1]\n", "[limits] tork"),
    ],
)
def test_a_broken_grounded_toml_is_told_before_a_target_is_written(w, table, named):
    head, _, rest = table.partition("\n")
    text = w.config.file.read_text()
    start = text.index(head)
    end = text.index("\n[", start)
    w.config.file.write_text(f"{text[:start]}{head}\n{rest}{text[end:]}")
    before = files(w)
    with pytest.raises(GroundedError, match=holding(named)):
        w.target({"theta": LINE})
    assert files(w) == before


T = np.linspace(0.0, 1.0, 201)
S_CURVE = {"x": 12 * T, "y": 2.5 * T**3 * (10 - 15 * T + 6 * T**2)}
COURSE = np.arctan2(np.gradient(S_CURVE["y"]), np.gradient(S_CURVE["x"]))
CIRCLE = {"x": np.sin(2 * np.pi * T), "y": 1 - np.cos(2 * np.pi * T)}


@pytest.mark.parametrize(
    ("path", "heading", "ok"),
    [
        (S_CURVE, COURSE, True),
        (S_CURVE, np.pi / 2 - COURSE, True),  # a compass
        (S_CURVE, COURSE + np.pi, True),  # backwards
        (S_CURVE, 1.5 + 0 * T, True),  # sideways
        ({"x": 12 * T, "y": 0 * T}, 1.5 + 0 * T, True),
        (S_CURVE, 3 * T, True),
        (S_CURVE, np.degrees(COURSE), False),
        (S_CURVE, 90 - np.degrees(COURSE), False),
        (CIRCLE, 2 * np.pi * T, True),
        (CIRCLE, 360 * T, False),
        (CIRCLE, (360 * T + 180) % 360 - 180, False),
    ],
)
def test_a_heading_in_degrees_beside_its_positions_is_refused(path, heading, ok):
    if ok:
        return refuse_degrees({**path, "psi": heading}, rover)
    with pytest.raises(GroundedError, match=holding("psi", "rad", "degrees", "pi / 180")):
        refuse_degrees({**path, "psi": heading}, rover)
