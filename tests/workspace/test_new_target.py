"""Replacing a target from Python: columns are checked before a file is written."""

import numpy as np
import pytest

from facts import holding
from grounded.errors import GroundedError
from grounded_trials import Workspace
from grounded_trials.workspace import new_target

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
    """In mm: 1/180^2 was written as 3.1e-05 and never changed again, 1/1800^2 as 0."""
    (tmp_path / "cart.py").write_text(CART)
    w = Workspace.create(tmp_path / "w", model=tmp_path / "cart.py")
    for far in (size, 1.0):
        w.target({"x": far * LINE})
        w.forget()
        assert w.task.reward.state[0] == pytest.approx(far**-2, rel=1e-4)
