"""After learning: diagnose, adopt, report, demo; the figures that `demo` prints."""

import shutil
from importlib.util import find_spec

import pytest

from cli import grounded
from facts import holds
from reported import cart, copied
from workspaces import make

__all__ = ["cart"]


@pytest.mark.slow
def test_demo_prints_utilities_and_trials(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    there = find_spec  # no recording without rerun
    monkeypatch.setattr(
        "grounded_cli.demo.find_spec", lambda name: None if name == "rerun" else there(name)
    )
    done = grounded("demo", "pendulum", "--json")
    assert done.code == 0, done.err
    found = done.json
    assert {"workspace", "utilities", "verdict", "trials"} <= set(found)
    assert found["utilities"][-1] > 0.65 * found["utilities"][0]
    folder = tmp_path / found["workspace"]
    assert (folder / "grounded.toml").is_file() and (folder / "reports").is_dir()
    assert "rrd" not in found["paths"] and found["paths"]["html"]
    assert all((tmp_path / path).is_file() for path in found["paths"].values())
    again = grounded("demo", "pendulum")
    assert again.code == 1 and holds(again.err, found["workspace"])


def test_demo_of_an_unknown_example(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = grounded("demo", "car-figure9")
    assert done.code == 1 and holds(done.err, "car-figure9", "'car-figure8'")
    assert not list(tmp_path.iterdir())


def test_a_workspace_without_trials_has_a_report_and_no_diagnosis(tmp_path):
    folder = make(tmp_path / "w").folder
    assert grounded("-C", folder, "report").code == 0
    for command in ("diagnose", "fit"):
        done = grounded("-C", folder, command)
        assert done.code == 1 and holds(done.err, "ingest", "--data")


def test_reports_may_be_deleted(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    shutil.rmtree(folder / "reports")
    first = grounded("-C", folder, "report", "--html", "--json").json
    shutil.rmtree(folder / "reports")
    assert grounded("-C", folder, "report", "--html", "--json").json == first
    assert grounded("-C", folder, "status").code == 0


def test_fit_then_learn_reaches_as_far(cart, tmp_path):
    w = copied(cart, tmp_path / "w")
    before = grounded("-C", w, "status", "--json").json["best"]["utility"]
    assert grounded("-C", w, "fit", "--latency", "--apply").code == 0
    done = grounded("-C", w, "learn", "--json").json
    assert done["best"]["utility"] >= before
