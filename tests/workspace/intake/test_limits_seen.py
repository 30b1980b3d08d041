"""[limits] that were read off one log: later logs go beyond them, and a plan stays at them."""

import numpy as np
import pytest

from cli import grounded
from facts import holds, of_code
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


@pytest.mark.parametrize("most, said", [(2.15, True), (1.175, False)])
def test_data_beyond_the_limits_are_told_how_far(w, tmp_path, most, said):
    write_trial(tmp_path / "d.mcap", driven(most), {"kind": "data"})
    told = of_code(w.ingest(tmp_path / "d.mcap", data=True), "log.limits")
    assert [(one.about, one.facts["how"]) for one in told] == [(("force",), "widen")] * said
    assert [one.facts["most"].value for one in told] == pytest.approx(
        [most - 1.17] * said, rel=1e-3
    )
    assert all(holds(one.sentence, "force", "0 to 1.17 N") for one in told)


def test_a_plan_and_a_target_name_the_log_whose_range_the_limits_are(tmp_path):
    config = CONFIG.replace("force = [-5.0, 5.0]", 'force = [-5, 5]\nseen_in = "a.csv"')
    w = Workspace(make(tmp_path / "w", config=config).folder)
    drawn = grounded("-C", w.folder, "target", "line", "--to", "x=1", "--json").json
    (told,) = (one for one in drawn["findings"] if one["code"] == "plan.limits_of_log")
    (again,) = of_code(w.propose(), "plan.limits_of_log")
    assert told["facts"]["log"] == again.facts["log"] == "a.csv"


@pytest.mark.parametrize("limit, said", [(0.3, True), (5.0, False)])
def test_a_first_plan_that_its_limits_keep_from_the_target_says_so(tmp_path, limit, said):
    config = CONFIG.replace("force = [-5.0, 5.0]", f"force = [-5.0, {limit}]")
    findings = Workspace(make(tmp_path / "w", config=config).folder).propose().findings
    told = [one for one in findings if one.code == "plan.falls_short"]
    assert len(told) == said
    assert all(one.about == ("force",) for one in told)
