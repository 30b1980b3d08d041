"""After learning: diagnose, adopt, report, view, demo; the figures that `demo` prints."""

import importlib.util
import json
import shutil
import subprocess
from pathlib import Path

import pytest

from cli import grounded, process
from facts import holds
from grounded_cli.main import COMMANDS
from workspaces import make

PAPER = {"car-turn": 0.97, "car-circle": 0.88}  # section 5.2; its 8: search/test_improve.py


def needs(name):
    there = importlib.util.find_spec(f"grounded_cli.{COMMANDS[name][0]}")
    return pytest.mark.skipif(there is None, reason=f"`grounded {name}` is not built yet")


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    folder = make(tmp_path_factory.mktemp("learned") / "w").folder
    assert grounded("-C", folder, "learn").code == 0
    return folder


@pytest.fixture
def w(learned, tmp_path):
    return Path(shutil.copytree(learned, tmp_path / "w"))


@pytest.fixture(scope="module")
def diagnosed(learned, tmp_path_factory):
    """The same with its diagnosis, and what that printed."""
    folder = Path(shutil.copytree(learned, tmp_path_factory.mktemp("diagnosed") / "w"))
    return folder, grounded("-C", folder, "diagnose", "--json")


@pytest.mark.parametrize("name", PAPER)
def test_learn_reaches_the_papers_figures_within_40_trials(name, tmp_path):
    folder = make(tmp_path / "w", name).folder
    done = grounded("-C", folder, "learn", "--json").json
    gain = 1 - done["utilities"][min(10, len(done["utilities"]) - 1)] / done["utilities"][0]
    assert gain >= PAPER[name] and done["trials"] <= 40


@pytest.mark.slow
@needs("demo")
def test_demo_prints_utilities_trials_and_the_optimum(tmp_path):
    done = process("demo", "pendulum", "--json", cwd=tmp_path)
    assert done.code == 0, done.err
    found = done.json
    assert {"workspace", "utilities", "verdict", "trials", "optimum"} <= set(found)
    assert found["utilities"][-1] > 0.65 * found["utilities"][0]
    assert found["optimum"] >= found["utilities"][-1] - 1e-3 * abs(found["optimum"])
    folder = tmp_path / found["workspace"]
    assert (folder / "grounded.toml").is_file() and (folder / "reports").is_dir()
    assert all((tmp_path / path).is_file() for path in found["paths"].values())
    again = process("demo", "pendulum", cwd=tmp_path)
    assert again.code == 1 and holds(again.err, found["workspace"], "--dir")


@needs("demo")
def test_demo_of_an_unknown_example(tmp_path):
    done = process("demo", "car-figure9", cwd=tmp_path)
    assert done.code == 1 and holds(done.err, "car-figure9", "'car-figure8'")
    assert not list(tmp_path.iterdir())


@needs("report")
@pytest.mark.extra("view")
def test_report_as_text_and_as_a_document(w):
    text = grounded("-C", w, "report")
    assert text.code == 0 and "utility" in text.out and "trajectories" in text.out
    assert not any(len(line) > 80 for line in text.out.splitlines())
    found = grounded("-C", w, "report", "--html", "--rrd", "--json").json
    assert {"paths", "utilities"} <= set(found) and len(found["utilities"]) >= 2
    files = [
        p
        for value in found["paths"].values()
        for p in ([value] if isinstance(value, str) else value)
    ]
    assert {Path(f).suffix for f in files} >= {".html", ".rrd"}
    assert all(Path(f).stat().st_size > 500 for f in files)
    rrd = next(f for f in files if f.endswith(".rrd"))
    if rerun := shutil.which("rerun"):
        assert subprocess.run([rerun, "rrd", "verify", rrd], check=False).returncode == 0


@needs("report")
def test_report_before_the_first_trial_is_no_failure(tmp_path):
    folder = make(tmp_path / "w").folder
    done = grounded("-C", folder, "report")
    assert done.code in (0, 1) and "Traceback" not in done.err
    assert (done.out + done.err).strip()


@needs("report")
def test_reports_may_be_deleted(w):
    first = grounded("-C", w, "report", "--html", "--json").json
    shutil.rmtree(w / "reports")
    assert grounded("-C", w, "report", "--html", "--json").json == first
    assert grounded("-C", w, "status").code == 0


@pytest.mark.slow
@needs("diagnose")
def test_diagnose_gives_the_contracts_document(diagnosed):
    w, done = diagnosed
    assert done.code == 0, done.err
    found = done.json
    assert {"verdict", "where", "ranking", "indistinguishable", "gap", "next_trial"} <= set(found)
    verdict = found["verdict"]
    assert verdict["kind"] in ("effect", "several", "none", "unknown") and verdict["sentence"]
    assert {"channels", "times", "regions"} <= set(found["where"])
    for channel in found["where"]["channels"]:
        assert {"name", "share", "rms", "unit"} <= set(channel)
    for entry in found["ranking"]:
        assert {"effect", "params", "evidence", "gap_after", "shrinkage"} <= set(entry)
    assert {"horizon_s", "unit", "before", "after", "floor", "held_out"} <= set(found["gap"])
    assert json.loads((w / "reports" / "diagnosis.json").read_text())["verdict"] == verdict
    text = grounded("-C", w, "diagnose")
    assert text.code == 0 and "Traceback" not in text.err


@needs("adopt")
def test_adopt_writes_the_effect_and_the_search_goes_on_from_the_best(diagnosed, tmp_path):
    made, document = diagnosed
    w = Path(shutil.copytree(made, tmp_path / "w"))
    name = document.json["ranking"][0]["effect"]
    before = grounded("-C", w, "status", "--json").json
    done = grounded("-C", w, "adopt", name, "--json")
    assert done.code == 0, done.err
    assert name in json.dumps(done.json["effects"])
    assert name in (w / "grounded.toml").read_text()
    after = grounded("-C", w, "status", "--json").json
    assert after["best"] == before["best"] and after["trials"] == before["trials"]
    assert grounded("-C", w, "propose", "--json").code == 0


@needs("adopt")
def test_adopt_of_nothing_known(w):
    done = grounded("-C", w, "adopt", "input_gian:force")
    assert done.code == 1 and "Traceback" not in done.err


@needs("diagnose")
def test_diagnose_without_trials_says_so(tmp_path):
    done = grounded("-C", make(tmp_path / "w").folder, "diagnose")
    assert done.code == 1 and holds(done.err, "ingest", "--data")


@needs("fit")
def test_fit_then_learn_reaches_as_far(w):
    before = grounded("-C", w, "status", "--json").json["best"]["utility"]
    assert grounded("-C", w, "fit", "--latency", "--apply").code == 0
    done = grounded("-C", w, "learn", "--json").json
    assert done["best"]["utility"] >= before
