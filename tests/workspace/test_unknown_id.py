"""Ids that are no trial or candidate: what exists, what was meant, and what belongs to it."""

import pytest

from cli import grounded, plain
from grounded.errors import GroundedError
from grounded_trials import Workspace
from workspaces import make


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """A workspace with the trials t0001 and t0002 of c0001 and c0002."""
    made = make(tmp_path_factory.mktemp("ids") / "w").folder
    grounded("-C", made, "learn", "--trials", "2")
    return Workspace(made)


WRONG = [  # command, what its message names
    (["discard", "c0002"], ["t0002"]),
    (["restore", "c0001"], ["t0001"]),
    (["diagnose", "--trials", "c0001"], ["t0001"]),
    (["diagnose", "--compare", "t0001", "c0002"], ["t0002"]),
    (["run", "t0002"], ["c0002"]),
    (["ingest", "x.mcap", "--candidate", "t0001"], ["c0001"]),
    (["export", "c0099"], ["c0099", "c0001", "c0002"]),
    (["discard", "t0099"], ["t0099", "t0001", "t0002"]),
    (["discard", "t2"], ["'t0002'"]),
    (["run", "2"], ["'c0002'"]),
    (["ingest", "t0001"], ["t0001"]),
    (["inspect", "t0001"], ["t0001"]),
    (["target", "c0001"], ["c0001"]),
    (["next", "c0001"], ["c0001"]),
]


@pytest.mark.parametrize(("command", "named"), WRONG, ids=lambda one: " ".join(one))
def test_an_id_of_the_other_kind_or_out_of_range_is_explained(ran, command, named):
    before = sorted(p.name for p in (ran.folder / "trials").iterdir())
    done = grounded("-C", ran.folder, *command)
    assert done.code == 1 and "Traceback" not in done.err
    for part in named:
        assert part in plain(done.err), done.err
    assert sorted(p.name for p in (ran.folder / "trials").iterdir()) == before


def test_an_id_may_be_written_in_capitals(ran, tmp_path):
    assert ran.export("C0002", tmp_path / "c.json").candidate == "c0002"
    assert ran.export("T0001", tmp_path / "t.csv").candidate == "t0001"


def test_an_empty_workspace_says_that_there_is_none_yet(tmp_path):
    bare = Workspace(make(tmp_path / "w").folder)
    for asked in (lambda: bare.export("c0001"), lambda: bare.discard("t0001")):
        with pytest.raises(GroundedError, match="none"):
            asked()


def test_discard_and_restore_report_what_they_did_not_change(ran):
    assert ran.restore("t0001").unchanged == ("t0001",)
    assert ran.discard("t0001", why="a dog").unchanged == ()
    assert ran.discard("t0001").unchanged == ("t0001",)
    again = ran.discard("t0001", why="a cat")
    assert again.then == ran.status().then and again.then.verb != "status"
    assert again.unchanged == () and again.discarded == {"t0001": "a cat"}
    with pytest.raises(GroundedError, match="t0001") as refused:
        ran.export("t0001")
    assert refused.value.then.arguments == ("t0001",) and refused.value.then.verb == "restore"
    ran.discard("t0002")
    with pytest.raises(GroundedError) as refused:  # nothing is left to fit
        ran.fit()
    assert refused.value.then.arguments == ("t0002",) and refused.value.then.verb == "restore"
    ran.restore("t0002")
    done = ran.restore("t0001")
    assert done.to_json() == {
        **{"trials": ["t0001"], "unchanged": []},
        **{"discarded": {}, "findings": []},
    }


def test_a_damaged_trial_that_was_set_aside_stays_so_when_its_log_comes_again(tmp_path):
    w = Workspace(make(tmp_path / "w").folder)
    w.propose()
    log = w.run().trial_file
    stored = w.folder / "trials" / f"t0001-{w.ingest(log).sha256[:16]}.mcap"
    w.discard("t0001", why="a dog")
    stored.chmod(0o644)
    stored.write_bytes(b"")
    found = w.ingest(log)
    assert found.trial == "t0001" and found.verdict == "set aside"
