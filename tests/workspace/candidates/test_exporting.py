"""Exports for other languages: a reader with nothing but the file drives the same commands."""

import csv
import json
import math
import re
import subprocess
import sys

import numpy as np
import pytest

from cli import grounded, plain
from facts import holding
from grounded.errors import GroundedError
from grounded.policy import load
from grounded_trials.workspace.candidates.exporting import (
    RUNNER,
    export_candidate,
)
from grounded_trials.workspace.candidates.proposing import propose_in
from grounded_trials.workspace.candidates.running import run_candidate
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.ingest import ingest_log
from grounded_trials.workspace.next_step import exported_as, to_run
from workspaces import CONFIG, make


def exported(w, folder, form):
    propose_in(w)
    path = folder / f"c.{form}"
    assert export_candidate(w, "c0001", form, path).candidate == "c0001"
    return path


def drive_by_json(document, states):
    """The control law of docs/robot.md in plain Python: z, differences that wrap, clip."""
    names, sent, out = document["state_names"], {}, []
    held = dict(zip(document["input_names"], document["past"], strict=True))
    for t, s in enumerate(states):
        z = list(s)
        for name in document["z_names"][len(names) :]:
            which, back = name[:-1].split("[t-")
            z.append(sent.get((which, t - int(back)), held[which]))
        command = []
        for i, name in enumerate(document["input_names"]):
            u = document["feedforward"][t][i]
            for j, value in enumerate(z if "gain" in document else ()):
                d = value - document["reference"][t][j]
                if j < len(names) and names[j] in document["angles"]:
                    d = math.remainder(d, 2 * math.pi)
                u += document["gain"][t][i][j] * d
            low, high = document["low"][i], document["high"][i]
            u = u if low is None else max(u, low)
            u = u if high is None else min(u, high)
            sent[name, t] = u
            command.append(u)
        out.append(command)
    return np.array(out)


@pytest.mark.parametrize("example", ["cart", "car-turn"])
def test_a_reader_of_the_json_drives_as_the_runner_does(tmp_path, example):
    w = make(tmp_path / "w", example)
    document = json.loads(exported(w, tmp_path, "json").read_text())
    run = load(exported(w, tmp_path, "npz"))
    H, n = run.policy.horizon, len(run.policy.state_names)
    states = np.zeros((H, n)) if run.policy.reference is None else run.policy.reference[:, :n]
    states = states + 0.2 * np.random.default_rng(0).normal(size=(H, n))
    expected = [run.action(t * run.policy.dt, states[t]) for t in range(H)]
    np.testing.assert_allclose(drive_by_json(document, states), expected, atol=1e-9)
    assert ("gain" in document) == (example != "car-turn")


def test_inputs_without_limits_are_null_in_json_and_said_in_csv(tmp_path):
    w = make(tmp_path / "w", config=CONFIG.replace("force = [-5.0, 5.0]", ""))
    document = json.loads(exported(w, tmp_path, "json").read_text())
    assert document["low"] == [None] and document["high"] == [None]
    text = exported(w, tmp_path, "csv").read_text()
    assert re.search(r"limits \[(none, none|-inf, inf)\]", text)
    with pytest.raises(GroundedError, match="limits"):
        exported(w, tmp_path, "npz")


def test_a_csv_is_read_by_any_reader_that_skips_hashes(tmp_path):
    w = make(tmp_path / "w", "car-circle")
    lines = exported(w, tmp_path, "csv").read_text().splitlines()
    head = [line for line in lines if line.startswith("#")]
    assert head == lines[: len(head)]  # all before the header
    rows = list(csv.DictReader(lines[len(head) :]))
    policy = w.candidate("c0001")[0].policy
    gain = np.array(
        [
            [[float(r[f"gain.{u}.{z}"]) for z in policy.z_names] for u in policy.input_names]
            for r in rows
        ]
    )
    np.testing.assert_array_equal(gain, policy.gain)


def test_the_runner_beside_an_export_drives_without_grounded(tmp_path):
    w = make(tmp_path / "w")
    (tmp_path / "robot").mkdir()
    propose_in(w)
    done = export_candidate(w, "c0001", path=tmp_path / "robot" / "c.npz", runner=True)
    assert done.format == "npz" and done.runner == tmp_path / "robot" / RUNNER
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import grounded_runner as g\n"
        "r = g.load(sys.argv[2], states=('x', 'v'), inputs=('force',))\n"
        "print(*[float(r.action(0.05 * k, [0.01 * k, 0.0])[0]) for k in range(40)])\n"
        "assert not any(n == 'grounded' or n.startswith('grounded.') for n in sys.modules)"
    )
    words = [sys.executable, "-I", "-c", code, str(done.runner.parent), str(done.file)]
    found = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    here = load(done.file)
    expected = [float(here.action(0.05 * k, [0.01 * k, 0.0])[0]) for k in range(40)]
    assert [float(u) for u in found.split()] == expected
    with pytest.raises(GroundedError, match=holding("npz", "json")):
        export_candidate(w, "c0001", "json", tmp_path / "c.json", runner=True)


def test_after_the_search_an_export_asks_for_no_further_run(tmp_path):
    w = make(tmp_path / "w").folder
    export = ("-C", w, "export", "best", "--runner", "-o", tmp_path / "c.npz")
    assert grounded("-C", w, "learn", "--trials", "1").code == 0
    assert not grounded(*export, "--json").json["search_ended"]
    assert grounded("-C", w, "learn").code == 0
    assert plain(grounded(*export).out).endswith("next: grounded report --html\n")
    assert grounded(*export, "--json").json["search_ended"]


def test_a_candidate_is_exported_beside_a_damaged_file_of_another(tmp_path):
    w = make(tmp_path / "w")
    ingest_log(w, run_candidate(w, propose_in(w).candidate.id).trial_file)
    second = propose_in(w).candidate.id
    ingest_log(w, run_candidate(w, second).trial_file)
    damaged = w.store.list()[-1].path
    damaged.chmod(0o644)
    damaged.write_bytes(damaged.read_bytes()[:-100])
    done = export_candidate(Folder(w.folder), "c0001", "json", tmp_path / "c.json")
    assert done.file.is_file() and done.named == ("--candidate", "c0001")
    with pytest.raises(GroundedError, match="damaged"):  # which one is best, nobody knows
        export_candidate(Folder(w.folder), "best", "json", tmp_path / "b.json")


def test_a_candidate_that_was_exported_is_to_be_run_and_its_log_taken_in(tmp_path, monkeypatch):
    w = make(tmp_path / "w", config=CONFIG.partition("[system]")[0])
    propose_in(w)
    monkeypatch.chdir(tmp_path)
    for form in ("npz", "json", "csv"):
        assert to_run(w, "c0001").verb == "export"
        path = tmp_path / f"c0001.{form}"
        export_candidate(w, "c0001", form, path)
        assert to_run(w, "c0001").verb == "next" and exported_as(w, "c0001") == form
        path.unlink()


def test_an_ending_that_names_no_format_is_refused_unless_the_format_is_named(tmp_path):
    w = make(tmp_path / "w")
    propose_in(w)
    ingest_log(w, run_candidate(w, None).trial_file)
    wrong = [("c0001", "a.xyz"), ("c0001", "a.mcap"), ("t0001", "a.foo"), ("t0001", "a.json")]
    for name, file in wrong:
        done = grounded("-C", w.folder, "export", name, "-o", tmp_path / file)
        assert done.code == 1 and "csv" in done.err and "npz" in done.err, done.err
        assert not (tmp_path / file).exists()
    done = grounded("-C", w.folder, "export", "t0001", "--runner", "-o", tmp_path / "b")
    assert done.code == 1 and not (tmp_path / "b").exists()
    named = grounded("-C", w.folder, "export", "c0001", "--format", "csv", "-o", tmp_path / "a.txt")
    assert named.code == 0 and (tmp_path / "a.txt").read_text().startswith("# format")
    plain_name = grounded("-C", w.folder, "export", "c0001", "-o", tmp_path / "plain")
    assert plain_name.code == 0 and json.loads((tmp_path / "plain").read_text())["dt"] == 0.05
    folder = grounded("-C", w.folder, "export", "c0001", "-o", ".")
    assert folder.code == 1 and "folder" in folder.err
