"""[limits] that were read off one log: later logs go beyond them, and a plan stays at them."""

from dataclasses import replace

import numpy as np
import pytest

from facts import holds
from grounded.instruments.limits import beyond_limits
from grounded.instruments.preflight import preflight
from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.store.trial_file import write_trial
from workspaces import CONFIG, make

NARROW = CONFIG.replace("force = [-5.0, 5.0]", "force = [0.0, 1.17]")
T = np.arange(200) * 0.05


def driven(most, low=0.0):
    force = low + (most - low) * (0.5 - 0.5 * np.cos(2 * T))[:, None]
    states = np.column_stack([np.zeros(201), np.zeros(201)])
    return Trial(states, force, 0.05, ("x", "v"), ("force",))


@pytest.fixture
def w(tmp_path):
    assert NARROW != CONFIG
    return Workspace(make(tmp_path / "w", config=NARROW).folder)


@pytest.mark.parametrize("most, said", [(2.15, True), (1.17, False), (1.175, False)])
def test_data_beyond_the_limits_are_told_how_far(w, tmp_path, most, said):
    write_trial(tmp_path / "d.mcap", driven(most), {"kind": "data"})
    found = w.ingest(tmp_path / "d.mcap", data=True).warnings
    told = [one for one in found if "[limits]" in one]
    assert len(told) == said
    assert all(holds(one, "force", f"{most:.4g}", "0 to 1.17 N", "widen") for one in told)


def test_commands_beyond_their_limits_are_not_said_to_be_at_them(w):
    """It said `at its limits 43 % of the time` of commands that went to twice the limit."""
    (found,) = preflight(w.task, [driven(2.15)]).findings
    share = float((driven(2.15).inputs > 1.17 + 0.0215).mean())
    assert (found.signal, found.kind) == ("force", "beyond")
    assert found.share == pytest.approx(share)
    assert holds(found.finding, "0 to 1.17 N", "0 to 2.15", f"{100 * share:.0f} %")
    clipped = driven(2.15)
    clipped = replace(clipped, inputs=np.minimum(clipped.inputs, 1.17))
    assert [one.kind for one in preflight(w.task, [clipped]).findings] == ["saturated"]


LOG = """
[log]
state = { x = { path = "/csv.x" }, v = { path = "/csv.v" } }
input = { force = { path = "/csv.force" } }
"""


def test_a_log_that_the_limits_were_read_off_is_not_said_to_be_at_them(tmp_path):
    """It said `at its limits 24 % of the time` of the log whose range [limits] are."""
    seen = NARROW.replace("force = [0.0, 1.17]", 'force = [0.0, 1.17]\nseen_in = "a.csv"')
    w = Workspace(make(tmp_path / "w", config=seen + LOG).folder)

    def ingested(name, most):
        run = driven(most)
        force = np.minimum(run.inputs[:, 0], 1.17)
        rows = np.column_stack([T, run.states[:-1], force])
        np.savetxt(tmp_path / name, rows, "%.9f", ",", header="t,x,v,force", comments="")
        w.ingest(tmp_path / name, data=True)
        return [one for one in w.preflight() if one.kind == "saturated"]

    assert ingested("a.csv", 2.15) == []
    (other,) = ingested("b.csv", 1.5)
    at = (driven(1.5).inputs >= 1.17).mean() + (driven(1.5).inputs <= 1e-9).mean()
    assert other.share == pytest.approx(float(at), abs=0.01)  # of the other log alone


def test_a_side_without_a_limit_has_no_beyond(w):
    free = replace(w.task, low=np.array([-np.inf]), high=np.array([np.inf]))
    assert not beyond_limits(free, driven(1e6).inputs).any()
    one = replace(w.task, low=np.array([-np.inf]))
    assert beyond_limits(one, driven(2.15).inputs).max() == pytest.approx(0.98, abs=1e-3)
    assert not beyond_limits(w.task, np.full((5, 1), np.nan)).any()


@pytest.mark.parametrize("limit, said", [(0.3, True), (5.0, False)])
def test_a_first_plan_that_its_limits_keep_from_the_target_says_so(tmp_path, limit, said):
    """It sent 1.17 m/s for 8 s, reached 2.2 of 3 m, and had no note."""
    config = CONFIG.replace("force = [-5.0, 5.0]", f"force = [-5.0, {limit}]")
    notes = Workspace(make(tmp_path / "w", config=config).folder).propose().proposal.notes
    told = [one for one in notes if "at its limit" in one]
    assert len(told) == said
    assert all(holds(one, "force", "0.3 N", "x", "[limits]") for one in told)
