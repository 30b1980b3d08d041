"""How exactly a robot is placed before its runs: a property of the rig, not of one task."""

from dataclasses import replace

import numpy as np
import pytest

from facts import of_code
from grounded_trials.store.trial_file import read_trial, write_trial
from grounded_trials.workspace.candidates.proposing import propose_in
from grounded_trials.workspace.candidates.running import run_candidate
from grounded_trials.workspace.discarding import set_aside
from grounded_trials.workspace.intake import gone_wrong
from grounded_trials.workspace.intake.gone_wrong import placing
from grounded_trials.workspace.intake.ingest import ingest_log
from workspaces import make


@pytest.fixture
def w(tmp_path):
    return make(tmp_path / "w")


def run(w):
    return run_candidate(w, propose_in(w).candidate.id).trial_file


def placed(w, tmp_path, ran, off):
    """Ingest a run that began `off` away."""
    moved = np.array(ran.states)
    moved[0, 0] += off
    write_trial(tmp_path / "t.mcap", replace(ran, states=moved), {"kind": "trial"})
    return ingest_log(w, tmp_path / "t.mcap", ran.candidate or "c0001")


def test_the_scatter_of_starts_is_learnt_from_discarded_runs_too(w, tmp_path, monkeypatch):
    ran, *_ = read_trial(run(w))
    monkeypatch.setattr(gone_wrong, "worth_of_start", lambda *_: 0.9 * w.task.utility(ran))
    assert of_code(placed(w, tmp_path, ran, 0.15), "run.start_spoils")
    for off in (-0.13, 0.11):
        set_aside(w, "discard", [placed(w, tmp_path, ran, off).trial], "")
        w.forget()
    rms, runs = placing(w, w.read())
    assert runs == 3 and rms[0] == pytest.approx(1.4826 * 0.13)
    found = placed(w, tmp_path, ran, -0.14)
    (told,) = of_code(found, "run.start*")
    assert (told.code, told.facts["runs"]) == ("run.start", 3)
    assert told.facts["rms"].value == pytest.approx(1.4826 * 0.13)
    assert found.then.verb == "propose"


@pytest.mark.parametrize(("share", "code"), [(-0.9, "run.start_spoils"), (0.9, "run.start")])
def test_a_run_that_is_better_from_either_start_counts(w, monkeypatch, share, code):
    """`share` of its cost is what its start has lost, or won if below 0."""
    worse = run(w)
    ingest_log(w, worse)
    worse, better = (read_trial(file)[0] for file in (worse, run(w)))
    utility = w.task.utility(better)
    assert utility > w.task.utility(worse)
    monkeypatch.setattr(gone_wrong, "worth_of_start", lambda *_: share * utility)
    moved = np.array(better.states)
    moved[0, 0] += 0.01
    assert gone_wrong.Run(w, replace(better, states=moved)).begun_elsewhere().code == code


def test_a_discarded_run_that_began_elsewhere_says_nothing_about_the_placing(w, tmp_path):
    ran, *_ = read_trial(run(w))
    for off in (0.01, -0.01, 0.9):
        last = placed(w, tmp_path, ran, off).trial
    set_aside(w, "discard", [last], "")
    w.forget()
    assert placing(w, w.read())[0][0] == pytest.approx(1.4826 * 0.01)
