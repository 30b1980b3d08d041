"""The end of a search is planned once, not by every command."""

import pytest

from cli import grounded
from grounded.errors import NextCommand
from grounded.findings import found
from grounded.search import improve
from grounded.search.standing import Ending, Proposal, ended, standing
from grounded_trials import Workspace
from workspaces import make

ASK = found("search.diagnose", then=NextCommand("diagnose"))


@pytest.fixture
def w(tmp_path):
    folder = make(tmp_path / "w").folder
    assert grounded("-C", folder, "learn", "--trials", "1").code == 0
    return Workspace(folder)


@pytest.fixture
def planned(monkeypatch):
    """Each planning of a next candidate, which takes a minute of CPU and finds none."""
    calls = []

    def propose(task, candidates, trials, options, *, identity, planner, tick):
        calls.append(identity)
        now = standing(task, candidates, trials, options, planner.fingerprint)
        return Proposal(ended(now, Ending.NO_STEP, ASK), None, is_new=False)

    monkeypatch.setattr(improve, "propose", propose)
    return calls


def test_an_end_is_planned_once_for_all_commands(w, planned):
    before = sorted(path.name for path in w.folder.rglob("*"))
    first, second, third = w.status(), w.status(), Workspace(w.folder).propose()
    assert planned == ["c0002"] and third.candidate is None
    for now in (second.standing, third.standing):
        assert now.to_json() == first.standing.to_json()
        assert now.findings == (ASK,)
    assert sorted(path.name for path in w.folder.rglob("*")) == before


def _safety(w):
    text = w.config.file.read_text()
    w.config.file.write_text(f"{text}\n[safety]\nv = [-50.0, 50.0]\n")


def _trial(w):
    assert grounded("-C", w.folder, "run", "best").code == 0
    (log,) = (w.folder / "runs").glob("c0001*")
    assert grounded("-C", w.folder, "ingest", log).code == 0


@pytest.mark.parametrize("change", [_safety, _trial])
def test_an_end_is_planned_again_after_a_change(w, planned, change):
    w.status()
    change(w)
    w.status()
    assert len(planned) == 2
