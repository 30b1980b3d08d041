"""A whole session as a person reads it: 80 columns, one trial and two trials, the same words."""

import re

import pytest

from cli import grounded, process
from facts import holds
from reported import cart, copied
from workspaces import CONFIG, make

__all__ = ["cart"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A new workspace, which is the current folder."""
    make(tmp_path / "w")
    monkeypatch.chdir(tmp_path / "w")
    return tmp_path / "w"


def test_repeats_say_what_is_waited_for(tmp_path):
    folder = make(tmp_path / "w", config=CONFIG.replace("[search]", "[search]\nrepeats = 2")).folder
    grounded("-C", folder, "propose")
    path = grounded("-C", folder, "run", "--json").json["trial_file"]
    taken = grounded("-C", folder, "ingest", path, "--json").json["trials"]
    assert taken[0]["verdict"] == "waiting"
    assert holds(grounded("-C", folder, "propose").out, "c0001", "1 trial")
    path = grounded("-C", folder, "run", "--json").json["trial_file"]
    assert grounded("-C", folder, "ingest", path, "--json").json["trials"][0]["verdict"] == "first"


# mistakes


@pytest.mark.parametrize(
    ("words", "holds"),
    [
        (["status", "-C", "grounded.toml"], "is a file: -C takes the folder"),
        (["ingest", "."], "is a workspace: give the log"),
        (["ingest", "model.py"], "model.py is not a log"),
        (["adopt", "x:y"], "nothing was diagnosed yet"),
        (["diagnose", "--trials", "t9,"], "there is no trial to learn from"),
        (["diagnose", "--without", "delay,delai"], "did you mean 'delay'"),
        (["diagnose", "--trials", ""], "--trials names no trial: expected some, like t0001"),
        (["fit", "--params", ","], "--params names no parameter: expected names such as a1,L"),
        (["diagnose", "--trials", " , "], "omit it to use all"),
        (["recover", "trials"], "is a folder"),
        (["recover", "model.py"], "look for another copy of the recording"),
        (["ingest", "nofile.mcap"], "nofile.mcap does not exist"),
        (["ingest", "no/nofile.mcap"], "nor does its folder no: give a path"),
        (["inspect", "nowhere.mcap"], "does not exist"),
    ],
)
def test_a_mistake_is_named(here, words, holds):
    done = grounded(*words)
    assert done.code == 1 and holds in done.err and "Errno" not in done.err, done.err


def test_a_file_says_its_format_and_must_not_contradict(here):
    done = process("export", "best", "--format", "csv", "-o", "x.npz", cwd=here)
    assert done.code == 2 and holds(done.err, "x.npz", "--format", "csv")


def test_the_best_one_is_run_again_by_that_name(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    best = grounded("-C", folder, "status", "--json").json["best"]["candidate"]
    done = grounded("-C", folder, "run", "best", "--json").json
    assert done["candidate"] == best
    out = grounded("-C", folder, "ingest", done["trial_file"]).out
    assert re.search(rf"^ +{best} +utility .*run again\b", out, re.M)
    empty = make(tmp_path / "empty").folder
    refused = grounded("-C", empty, "run", "best")
    assert refused.code == 1 and holds(refused.err, "best")
