"""grounded report: what it says, in what shape, and what it does where files are damaged."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cli import grounded, plain
from grounded_trials import Workspace
from grounded_trials.logs.signals import SignalSpec, read_signals
from grounded_trials.workspace.folder import Folder
from reported import DIAGNOSIS, car, cart, copied, damage, stored
from workspaces import make

__all__ = ["car", "cart"]


def test_text_fits_a_terminal_and_ends_with_the_next_command(cart, car):
    for folder, command in ((cart, "adopt viscous_friction:v"), (car, "propose")):
        done = grounded("-C", folder, "report")
        assert done.code == 0, done.err
        lines = done.out.rstrip("\n").split("\n")
        assert max(map(len, lines)) <= 80
        assert plain(done.out).split("\n")[-2] == f"next: grounded {command}"
        assert "\x1b" not in done.out


def test_json_holds_what_the_contract_says(cart):
    document = grounded("-C", cart, "report", "--json").json
    status = grounded("-C", cart, "status", "--json").json
    assert document["utilities"] == status["utilities"]
    assert document["paths"] == {}
    assert document["verdict"]["effects"] == DIAGNOSIS["verdict"]["effects"]
    assert document["best"]["candidate"] == status["best"]["candidate"]
    assert set(document["best"]["tracking_error"]) == {"x", "v"}
    assert document["best"]["tracking_error"]["v"] is None  # no target: not a number


@pytest.mark.slow
@pytest.mark.extra("view", "png")
def test_json_names_the_files_that_were_written(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    paths = grounded("-C", folder, "report", "--html", "--rrd", "--png", "--json").json["paths"]
    files = [paths["html"], paths["rrd"], *paths["png"]]
    assert all(Path(file).stat().st_size > 1000 for file in files)
    assert {Path(p).stem for p in paths["png"]} >= {"utility", "paths", "states", "bias"}


@pytest.mark.extra("view", "png")
def test_a_workspace_without_trials_has_a_report(tmp_path):
    make(tmp_path / "w")
    done = grounded("-C", tmp_path / "w", "report", "--html", "--png", "--rrd")
    assert done.code == 0, done.err
    assert plain(grounded("-C", tmp_path / "w", "report").out).endswith("next: grounded propose\n")


@pytest.mark.extra("view", "png")
def test_a_damaged_trial_is_left_out_and_named(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    path = damage(folder, "trials/t0002-*")
    done = grounded("-C", folder, "report")
    assert done.code == 3
    assert path.name in done.out
    assert plain(done.out).rstrip().split("\n")[-1].startswith("next: grounded ")
    document = grounded("-C", folder, "report", "--json", "--html", "--rrd")
    assert document.code == 3
    assert document.json["lost"][0]["file"] == path.name
    assert path.name in Path(document.json["paths"]["html"]).read_text()


@pytest.mark.extra("view", "png")
def test_all_trials_may_be_lost(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    for number, path in enumerate(sorted(folder.glob("trials/*.mcap"))):
        path.chmod(0o644)
        path.write_bytes(b"" if number % 2 else b"\x89MCAP0\r\n nonsense")
    done = grounded("-C", folder, "report", "--html", "--png", "--rrd")
    assert done.code == 3, done.err


def test_a_damaged_candidate_is_taken_from_the_trial_that_ran_it(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    damage(folder, "candidates/c0002.mcap")
    (folder / "candidates" / "c0001.mcap").unlink()
    done = grounded("-C", folder, "report", "--json")
    assert done.code == 0, done.err
    assert done.json["utilities"] == grounded("-C", cart, "report", "--json").json["utilities"]


@pytest.mark.parametrize("text", ["", "[]", '{"verdict": 3}', "\x00", "[" * 100_000])
def test_a_damaged_diagnosis_is_named(cart, tmp_path, text):
    folder = copied(cart, tmp_path / "w")
    (folder / "reports" / "diagnosis.json").write_text(text)
    done = grounded("-C", folder, "report", "--json")
    assert done.code == 3
    (lost,) = done.json["lost"]
    assert lost["file"] == "diagnosis.json" and lost["reason"]


@pytest.mark.extra("view")
def test_the_first_trial_may_be_lost_and_a_short_one_is_shown_as_failed(cart, tmp_path):
    w = Folder(copied(cart, tmp_path / "w"))
    trial = w.trials()[-1].trial
    states = np.array(trial.states[:11])
    states[7:] = np.nan
    short = replace(trial, states=states, inputs=trial.inputs[:10])
    about = {"kind": "trial", "task": w.task.hash}
    stored(w, short, about, w.candidate_bytes(short.candidate))
    assert "failed" in grounded("-C", w.folder, "report").out
    damage(w.folder, "trials/t0001-*")
    assert grounded("-C", w.folder, "report", "--html", "--rrd").code == 3


def test_nothing_heavy_is_imported_for_text(cart):
    script = (
        "import sys; sys.argv = ['grounded', '-C', sys.argv[1], 'report']\n"
        "from grounded_cli.main import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "heavy = {'rerun', 'plotly', 'jinja2', 'matplotlib', 'scipy.optimize'} & set(sys.modules)\n"
        "print(heavy, file=sys.stderr); sys.exit(bool(heavy))"
    )
    done = subprocess.run([sys.executable, "-c", script, str(cart)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.extra("view", "png")
def test_a_workspace_of_data_only_shows_the_model_against_the_data(cart, tmp_path):
    folder = tmp_path / "data"
    make(folder)
    for path in sorted(cart.glob("trials/t000[12]-*")):
        assert grounded("-C", folder, "ingest", path, "--data").code == 0
    done = grounded("-C", folder, "report", "--html", "--png", "--rrd", "--json")
    assert done.code == 0, done.err
    names = ["paths", "data-t0001", "data-t0002", "residual"]
    assert [Path(p).stem for p in done.json["paths"]["png"]] == names
    shown = Path(done.json["paths"]["html"]).read_text()
    assert "t0001" in shown


@pytest.mark.extra("view", "png")
def test_a_candidate_that_was_not_run_yet_is_shown_as_predicted(tmp_path):
    make(tmp_path / "w")
    assert grounded("-C", tmp_path / "w", "propose").code == 0
    done = grounded("-C", tmp_path / "w", "report", "--html", "--rrd", "--png", "--json")
    assert done.code == 0, done.err
    assert "c0001" in Path(done.json["paths"]["html"]).read_text()
    assert plain(grounded("-C", tmp_path / "w", "report").out).endswith("next: grounded run\n")


@pytest.mark.parametrize("form", ["csv", "npz"])
def test_a_trial_that_was_exported_is_read_back(cart, tmp_path, form):
    trial, file = Workspace(cart).trials()[0].trial, tmp_path / f"run.{form}"
    assert grounded("-C", cart, "export", "t0001", "-o", file, "--json").json["format"] == form
    found = read_signals(file, {"v": SignalSpec(f"/{form}.v")})["v"]
    np.testing.assert_allclose(found.values, trial.states[:, trial.state_names.index("v")])
