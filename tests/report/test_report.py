"""grounded report: what it says, in what shape, and what it does where files are damaged."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cli import grounded, plain
from facts import holds
from grounded_trials.report.findings import (
    improvements_in,
    off_target,
    prediction_error,
    rms,
)
from grounded_trials.report.gathering import gather
from grounded_trials.store.documents import write_document
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.off_target import tracking_error
from reported import DIAGNOSIS, car, cart, copied, damage
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
        for heading in ("utility", "trajectories", "bias", "gap to the model"):
            assert any(line.startswith(heading) for line in lines)


def test_text_shows_the_ruler(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    row = {
        "horizon_s": 1.0,
        "unit_by_channel": {"v": "m/s"},
        "crude": {"v": 0.31},
        "calibrated": {"v": 0.12},
        "with_effects": {"v": 0.08},
        "noise_floor": {"v": None},
    }
    credit = [{"of": "viscous_friction:v", "share": 0.62, "times": 1.83}]
    document = DIAGNOSIS | {"prediction_error": [row], "credit": credit}
    write_document(folder / "reports" / "diagnosis.json", document)
    lines = grounded("-C", folder, "report").out.splitlines()
    (line,) = [x for x in lines if x.startswith("v, 1 s ahead")]
    assert line.split()[4:] == ["0.310", "0.120", "0.0800", "-", "m/s"]
    assert any("viscous_friction:v" in x and "+83 %" in x for x in lines)


def test_json_holds_what_the_contract_says(cart):
    document = grounded("-C", cart, "report", "--json").json
    status = grounded("-C", cart, "status", "--json").json
    assert document["utilities"] == status["utilities"]
    assert document["paths"] == {}
    assert document["verdict"] == DIAGNOSIS["verdict"]
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
    assert {Path(p).stem for p in paths["png"]} >= {"utility", "paths", "states", "bias", "gap"}


@pytest.mark.extra("view", "png")
def test_a_workspace_without_trials_has_a_report(tmp_path):
    make(tmp_path / "w")
    done = grounded("-C", tmp_path / "w", "report", "--html", "--png", "--rrd")
    assert done.code == 0, done.err
    assert plain(grounded("-C", tmp_path / "w", "report").out).endswith("next: grounded propose\n")


def test_findings_measure_what_they_say(cart):
    findings = gather(Folder(cart))
    task, best = findings.task, findings.best
    assert best is not None
    off = best.trial.states[:, 0] - task.target[:, 0]
    assert rms(tracking_error(task, best.trial))[0] == pytest.approx(np.sqrt(np.mean(off**2)))
    gap = best.trial.states - best.candidate.predicted_states
    np.testing.assert_allclose(prediction_error(task, best), gap)
    step = task.model.system.step(
        best.trial.states[:-1], best.trial.inputs, task.model.values, task.dt
    )
    np.testing.assert_allclose(best.residual, best.trial.states[1:] - step, atol=1e-12)


def test_the_diagnosed_effect_leaves_less_of_the_bias(cart):
    best = gather(Folder(cart)).best
    assert best is not None and best.explained is not None
    assert rms(best.explained)[1] < rms(best.residual)[1]


@pytest.mark.extra("view", "png")
def test_a_damaged_trial_is_left_out_and_named(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    path = damage(folder, "trials/t0002-*")
    done = grounded("-C", folder, "report")
    assert done.code == 3
    assert path.name in done.out and "is damaged" in " ".join(plain(done.out).split())
    assert plain(done.out).rstrip().split("\n")[-1].startswith("next: grounded ")
    document = grounded("-C", folder, "report", "--json", "--html", "--rrd")
    assert document.code == 3
    assert document.json["lost"][0]["file"] == path.name
    page = Path(document.json["paths"]["html"]).read_text()
    assert path.name in page and document.json["lost"][0]["reason"].split(";")[0] in page


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


@pytest.mark.slow
@pytest.mark.extra("view", "png")
def test_the_first_trial_may_be_lost_and_a_short_one_is_shown_as_failed(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    workspace = Folder(folder)
    from dataclasses import replace

    from grounded_trials.store.trial_file import trial_bytes

    stored = workspace.trials()[-1]
    states = np.array(stored.trial.states[:11])
    states[7:] = np.nan
    short = replace(stored.trial, states=states, inputs=stored.trial.inputs[:10], id="")
    model = workspace.base_model
    workspace.store.add(
        trial_bytes(
            short,
            {"kind": "trial", "task": workspace.task.hash},
            workspace.candidate_bytes(short.candidate),
            state_units=dict(model.states),
            input_units=dict(model.inputs),
            start_ns=0,
        )
    )
    done = grounded("-C", folder, "report", "--html", "--rrd", "--json")
    assert done.code == 0, done.err
    assert "failed" in grounded("-C", folder, "report").out
    damage(folder, "trials/t0001-*")
    done = grounded("-C", folder, "report", "--html", "--png", "--rrd")
    assert done.code == 3, done.err


def test_a_trial_that_names_a_file_elsewhere_reads_nothing_there(cart, tmp_path):
    from dataclasses import replace

    from grounded_trials.store.trial_file import trial_bytes

    folder = copied(cart, tmp_path / "w")
    workspace = Folder(folder)
    (tmp_path / "outside.mcap").write_bytes(workspace.candidate_bytes("c0001"))
    model = workspace.base_model
    evil = replace(workspace.trials()[0].trial, candidate="../../outside", id="")
    units = {"state_units": dict(model.states), "input_units": dict(model.inputs)}
    workspace.store.add(trial_bytes(evil, {"kind": "trial"}, None, start_ns=0, **units))
    before = grounded("-C", cart, "report", "--json").json
    after = grounded("-C", folder, "report", "--json").json
    assert after["utilities"] == before["utilities"]


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
    names = ["paths", "data-t0001", "data-t0002", "residual", "autocorrelation"]
    assert [Path(p).stem for p in done.json["paths"]["png"]] == names
    assert "t0001, crude" in Path(done.json["paths"]["html"]).read_text()
    out = grounded("-C", folder, "report").out
    assert holds(out, "2 logs") and "1 s after each restart" in out


@pytest.mark.extra("view", "png")
def test_a_candidate_that_was_not_run_yet_is_shown_as_predicted(tmp_path):
    make(tmp_path / "w")
    assert grounded("-C", tmp_path / "w", "propose").code == 0
    done = grounded("-C", tmp_path / "w", "report", "--html", "--rrd", "--png", "--json")
    assert done.code == 0, done.err
    assert "predicted for c0001" in Path(done.json["paths"]["html"]).read_text()
    assert plain(grounded("-C", tmp_path / "w", "report").out).endswith("next: grounded run\n")


def test_two_trials_of_a_candidate_miss_by_more_than_their_mean(cart):
    findings = gather(Folder(cart))
    best = findings.runs_of(findings.best.candidate.id)[-1]
    target = np.nan_to_num(findings.task.target)
    two = [
        replace(best, trial=replace(best.trial, id=f"t009{k}", states=target + sign * 0.31))
        for k, sign in enumerate((1, -1))
    ]
    runs = (*(r for r in findings.runs if r.candidate.id != best.candidate.id), *two)
    found = replace(findings, runs=runs)
    assert rms(off_target(found, found.best))[0] == pytest.approx(0.31)
    told = next(one for one in improvements_in(found) if "x" in one.what)
    assert told.after == pytest.approx(0.31)
