"""The front door: a method for every command, and what it says of ids that are none."""

import shutil
import subprocess
import sys

import numpy as np
import pytest

from cli import grounded
from cli import plain as said
from facts import holding
from grounded.errors import GroundedError, NextCommand
from grounded.result import Result, plain
from grounded_trials import Workspace
from reported import copied
from workspaces import make


def test_importing_the_package_costs_nothing():
    code = "import sys, grounded_trials; assert 'numpy' not in sys.modules; "
    code += "from grounded_trials import Workspace; print('scipy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_a_name_that_is_not_there():
    import grounded_trials

    with pytest.raises(AttributeError, match="Workshop"):
        _ = grounded_trials.Workshop


def test_a_folder_that_is_no_workspace(tmp_path):
    with pytest.raises(GroundedError) as refused:
        Workspace(tmp_path)
    assert refused.value.then is not None and refused.value.then.verb == "init"


def test_a_session_from_an_example_to_a_report(tmp_path):
    w = Workspace.create(tmp_path / "w", example="pendulum")
    first = w.propose()
    assert first.then == NextCommand("run") and first.candidate.id == "c0001"
    ran = w.run()
    assert ran.then == NextCommand("ingest", (str(ran.trial_file),)) == w.status().then
    found = w.ingest(ran.trial_file)
    assert (found.trial, found.verdict, found.then) == ("t0001", "first", NextCommand("propose"))
    seen = []
    status = w.learn(1, each=lambda candidate, trial: seen.append((candidate.id, trial.trial)))
    assert seen == [("c0002", "t0002")] and status.standing.trials == 2
    report = w.report(html=True)
    assert [path.name for path in report.paths] == ["report.html"]
    assert not report.findings.lost
    assert w.verify().damaged == ()


def test_the_condition_of_a_run_is_named_and_named_anew(tmp_path):
    w = Workspace.create(tmp_path / "w", example="pendulum")
    w.propose()
    file = w.run().trial_file
    for group in ("wet", "dry", "", "wet"):  # "" leaves what was named
        assert w.ingest(file, group=group).trial == "t0001"
        (trial,) = w.task_trials()
        assert trial.group == (group or "dry")
    (measured,) = w.task_trials(measured=True)
    assert measured.group == "wet" and w.verify().damaged == ()


@pytest.mark.parametrize(
    ("verb", "options"),
    [
        ("propose", ()),
        ("status", ()),
        ("fit", ()),
        ("report", ("--html",)),
        ("verify", ()),
        ("inspect", ("trials/t.mcap",)),
        ("export", ("best", "-o", "best.csv")),
        ("adopt", ("viscous_friction:v",)),
    ],
)
def test_the_document_is_the_command_s(cart, tmp_path, monkeypatch, verb, options):
    for side in ("a", "b"):
        copied(cart, tmp_path / side)
        (first, *_) = (tmp_path / side / "trials").glob("t0001-*")
        shutil.copy(first, tmp_path / side / "trials" / "t.mcap")
    monkeypatch.chdir(tmp_path / "a")
    printed = grounded(verb, *options, "--json")
    assert printed.code == 0, printed.err
    monkeypatch.chdir(tmp_path / "b")
    w = Workspace()
    calls = {"report": lambda: w.report(html=True), "export": lambda: w.export("best", "best.csv")}
    found = calls.get(verb, lambda: getattr(w, verb)(*options))()
    assert isinstance(found, Result)
    assert plain(found.to_json()) == printed.json
    assert repr(found).startswith(f"<{type(found).__name__} ") and len(repr(found)) < 200
    assert "<table>" in found._repr_html_()


def test_one_reader_strict_or_telling_what_it_lost(cart, tmp_path):
    w = Workspace(copied(cart, tmp_path / "w"))
    whole = w.read()
    assert not whole.lost and len(whole.trials) > 2
    (second,) = w.store.folder.glob("t0002-*")
    second.chmod(0o644)
    second.write_bytes(second.read_bytes()[:-30])
    (third,) = w.store.folder.glob("t0003-*")
    third.unlink()
    (w.folder / "candidates" / "c0001.mcap").write_bytes(b"no")
    w.forget()
    with pytest.raises(GroundedError, match="t0002"):
        w.read()
    found = w.read(strict=False)
    assert [one.file for one in found.lost] == [second.name, "t0003"]
    assert len(found.trials) == len(whole.trials) - 2
    assert [c.id for c in found.candidates] == [c.id for c in whole.candidates]
    assert np.array_equal(
        found.candidates[0].predicted_states, whole.candidates[0].predicted_states
    )


@pytest.mark.parametrize(
    ("call", "facts"),
    [
        (lambda w: w.ingest(5), ("path", "int")),
        (lambda w: w.ingest(w.trials()[0]), ("path",)),
        (lambda w: w.next(None), ("path", "NoneType")),
        (lambda w: w.inspect(5), ("path", "int")),
        (lambda w: w.learn(trials="3"), ("trials", "'3'")),
        (lambda w: w.learn(trials=-1), ("trials", "-1")),
        (lambda w: w.diagnose("t0001"), ("['t0001']",)),
        (lambda w: w.diagnose([1]), ("trials", "int")),
        (lambda w: w.preflight("t0001"), ("['t0001']",)),
        (lambda w: w.diagnose(max_effects=13), ("max_effects", "12")),
    ],
)
def test_arguments_of_another_type(cart, tmp_path, call, facts):
    w = Workspace(copied(cart, tmp_path / "w"))
    with pytest.raises(GroundedError, match=holding(*facts)):
        call(w)


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
        assert part in said(done.err), done.err
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
