"""Slips at the track: what somebody types who knows the tool only by its help."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from cli import grounded, plain
from grounded_trials import Workspace
from grounded_trials.store.documents import write_document
from grounded_trials.store.trial_file import read_trial
from reported import DIAGNOSIS, cart, copied
from workspaces import make

__all__ = ["cart"]


@pytest.fixture
def w(cart: Path, tmp_path: Path) -> Path:
    return copied(cart, tmp_path / "w")


def test_trials_may_be_given_as_a_list_with_commas_and_twice(w):
    before = len(list((w / "trials").glob("n*.json")))
    done = grounded("-C", w, "discard", "t0001,t0002", "T0001", "--json")
    assert done.code == 0 and list(done.json["trials"]) == ["t0001", "t0002"]
    assert len(list((w / "trials").glob("n*.json"))) == before + 2  # one note each
    done = grounded("-C", w, "restore", "t0001,t0002", "--json")
    assert list(done.json["trials"]) == ["t0001", "t0002"] and not done.json["discarded"]


# words at a workspace whose search has ended, the exit code, and what the message names
SLIPS = [
    (["adopt", "delay"], 1, "'delay:force'"),
    (["status", "-C", "grounded.toml"], 1, "-C"),
    (["ingest", "."], 1, "workspace"),
    (["ingest", "model.py"], 1, "model.py"),
    (["diagnose", "--trials", "t9,"], 1, "t0001"),
    (["diagnose", "--without", "delay,delai"], 1, "'delay'"),
    (["diagnose", "--trials", " , "], 1, "--trials"),
    (["fit", "--params", ","], 1, "--params"),
    (["recover", "trials"], 1, "folder"),
    (["recover", "model.py"], 1, "model.py"),
    (["ingest", "nofile.mcap"], 1, "nofile.mcap"),
    (["ingest", "no/nofile.mcap"], 1, "folder no"),
    (["inspect", "nowhere.mcap"], 1, "nowhere.mcap"),
    (["export", "best", "--format", "csv", "-o", "x.npz"], 2, "--format"),
    (["target", "line", "--to", "x=1", "--seconds", "1e9"], 1, "200000"),
    (["target", "step", "--hold", "1"], 2, "--hold"),
    (["target", "circle", "--seconds", "1"], 2, "--seconds"),
    *(
        (["target", "line", "--to", f"x={value}", "--seconds", "2"], 2, f"x={value}")
        for value in ("nan", "-inf", "fast", "")
    ),
]


@pytest.mark.parametrize(("words", "code", "named"), SLIPS)
def test_a_mistake_is_named(w, monkeypatch, words, code, named):
    monkeypatch.chdir(w)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        done = grounded(*words)
    assert done.code == code and named in " ".join(done.err.split()), done.err
    assert "Errno" not in done.err and "nan" not in done.err.replace("x=nan", "")


def test_nothing_was_diagnosed_yet(tmp_path):
    done = grounded("-C", make(tmp_path / "w").folder, "adopt", "x:y")
    assert done.code == 1 and plain(done.err).endswith("next: grounded diagnose\n")


def test_the_best_one_is_run_again_by_that_name(w, tmp_path):
    here = Workspace(w)
    best = here.status().standing.incumbent.candidate.id
    ran = here.run("best")
    assert ran.candidate == best and here.ingest(ran.trial_file).verdict == "run again"
    assert grounded("-C", make(tmp_path / "empty").folder, "run", "best").code == 1


def test_a_stored_trial_its_file_and_its_table_are_targets(w):
    table, (own,) = w / "t0001.csv", (w / "trials").glob("t0001-*.mcap")
    assert grounded("-C", w, "export", "t0001", "--format", "csv", "-o", table).code == 0
    ran = read_trial(own)[0].states
    for given in ("T0001", own, table):
        (w / "target.csv").write_text("")
        done = grounded("-C", w, "target", given, "--json")
        assert done.code == 0 and sorted(done.json["columns"]) == ["v", "x"], done.err
        drawn = np.genfromtxt(w / "target.csv", delimiter=",", names=True)
        np.testing.assert_allclose(drawn["x"], ran[:, 0], atol=1e-5)
    assert grounded("-C", w, "discard", "t0001").code == 0
    done = grounded("-C", w, "target", "t0001")
    assert done.code == 1 and "restore" in done.err


@pytest.mark.parametrize("changed", [True, False])
def test_nothing_is_adopted_from_two_robots_compared(w, changed):
    value = {"value": 0.1, "std": 0.01}
    one = {"effect": "parameter:m", "quantity": "m", "first": value, "second": value}
    made = {"trials": ["t0001", "t0002"], "named": ["t0002"], "compared": ["t0001"]}
    document = {**DIAGNOSIS, "changed": [one] * changed, "diagnosed": made}
    write_document(w / "reports" / "diagnosis.json", document)
    before = (w / "grounded.toml").read_text()
    done = grounded("-C", w, "adopt", "viscous_friction:v")
    assert done.code == changed and ((w / "grounded.toml").read_text() == before) == changed
