"""Slips at the track: what somebody types who knows the tool only by its help."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from cli import grounded
from facts import holds
from grounded_trials.store.documents import write_document
from grounded_trials.store.trial_file import read_trial
from reported import DIAGNOSIS, cart, copied

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


def test_a_family_without_its_target_is_completed(w):
    done = grounded("-C", w, "adopt", "delay")
    assert done.code == 1 and "did you mean 'delay:force'?" in done.err


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "fast", ""])
def test_an_end_that_is_no_number_is_refused(w, value):
    done = grounded("-C", w, "target", "line", "--to", f"x={value}", "--seconds", "2")
    assert done.code == 2 and holds(done.err, f"--to x={value}", "STATE=VALUE")


def test_a_line_of_a_billion_seconds_is_refused_without_a_warning_of_numpy(w):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        done = grounded("-C", w, "target", "line", "--to", "x=1", "--seconds", "1e9")
    assert done.code == 1 and holds(done.err, "1e+09 s", "200000") and "nan" not in done.err


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
    assert done.code == 1 and holds(done.err, "set aside", "restore")


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
    if changed:
        assert holds(" ".join(done.err.replace("\\", " ").split()), "diagnose --trials t0002")
