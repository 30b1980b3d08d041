"""Candidates that a diagnosis offers or that are written before there is a target."""

from dataclasses import replace

import numpy as np
import pytest

from cli import grounded
from grounded.effects import Library
from grounded.errors import GroundedError, NextCommand
from grounded_trials import Workspace
from grounded_trials.workspace.candidates.handover import checked_candidate
from grounded_trials.workspace.last_diagnosis import read_diagnosis
from grounded_trials.workspace.next_step import to_run
from reported import copied
from workspaces import CONFIG, MODEL, edit, make

FEW = Library(tuple(map(Library().family, ("viscous_friction", "input_gain", "delay"))))
TIE = ("delay:force", "input_gain:force")
NOISY = CONFIG + "[system.noise.measurement]\nx = 0.02\nv = 0.05\n"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A noisy cart after three trials, and its diagnosis."""
    w = Workspace(make(tmp_path_factory.mktemp("w") / "w", config=NOISY).folder)
    w.learn(3)
    return w.folder, w.diagnose(library=FEW)


@pytest.fixture
def diagnosed(made, tmp_path, monkeypatch):
    """A copy of it in which `diagnose` finds that again, with a tie that any probe tells."""
    folder, found = made
    tied = replace(found, indistinguishable=(TIE,), equivalent=())
    monkeypatch.setattr("grounded_trials.workspace.diagnosing.diagnose", lambda *_, **__: tied)
    monkeypatch.setattr("grounded.search.design.NATS", 0.0)
    w = Workspace(copied(folder, tmp_path / "w"))
    return w, w.diagnose(library=FEW)


@pytest.mark.slow
def test_every_probe_that_is_offered_is_handed_over(diagnosed):
    w, found = diagnosed
    assert found.probe
    reached = w.candidate(found.probe)[0].predicted_states[:, 0]
    handed = []
    for room in (0.5, 0.05, 0.0):
        edit(w.folder, safety=f"x = [-1.0, {reached.max() + room}]")
        if identity := w.diagnose(library=FEW).probe:
            handed.append(checked_candidate(w, identity))
    assert len(handed) >= 2 and all(one.overridden == () for one in handed)
    edit(w.folder, safety=f"x = [{reached.min() - 0.01}, {reached.max() + 0.5}]")
    assert w.diagnose(library=FEW).probe == ""


def test_people_export_a_probe(diagnosed, tmp_path):
    w, found = diagnosed
    assert to_run(w, found.probe, found.probe) == NextCommand("run", (found.probe,))
    bare = make(tmp_path / "bare", config=CONFIG.partition("[system]")[0])
    assert to_run(bare, "c0004", "c0004") == NextCommand("export", ("c0004", "--runner"))


def test_without_safety_a_probe_stays_near_where_trials_have_been(diagnosed):
    w, found = diagnosed
    been = np.vstack([trial.states for trial in w.task_trials()])
    room = 0.5 * np.ptp(been, axis=0) + 1e-9
    made = w.candidate(found.probe)[0].predicted_states
    assert (made > been.min(axis=0) - room).all() and (made < been.max(axis=0) + room).all()


def test_a_probe_that_fails_costs_no_diagnosis(diagnosed, monkeypatch, caplog):
    w, before = diagnosed

    def broken(*args):
        raise KeyError("lag_1")

    monkeypatch.setattr("grounded_trials.workspace.diagnosing.probe", broken)
    found = w.diagnose(library=FEW)
    assert found.verdict == before.verdict and found.probe == ""
    assert caplog.records[-1].exc_info[0] is KeyError  # the traceback of our mistake is not lost
    kept = read_diagnosis(w.reports)
    assert kept is not None and kept.next_trial == found.next_trial


BARE = CONFIG.replace('target = "target.csv"\n', "").replace("state = { x = 10.0 }\n", "")
SAFE = BARE + "\n[safety]\nx = [-2.0, 2.0]\n"


def codes(done):
    return [one["code"] for one in done["findings"]]


def test_from_a_bare_model_to_fitted_values(tmp_path):
    w = make(tmp_path / "w", config=SAFE).folder
    made = grounded("-C", w, "excite", "--seconds", "5", "--json").json
    assert made["seconds"] == 5.0 and not made["feedback"] and codes(made) == []
    for one in made["parameters"].values():
        assert one["std_after"] < 0.1 * one["std"]
    ran = grounded("-C", w, "run", made["candidate"], "--json").json
    assert grounded("-C", w, "ingest", ran["trial_file"]).code == 0
    fitted = grounded("-C", w, "fit", "--json").json["params"]
    assert fitted["mass"]["value"] == pytest.approx(1.4, rel=0.2)  # its latency is not in the model
    assert grounded("-C", w, "fit", "--apply").code == 0  # what is known better is begun with
    again = grounded("-C", w, "excite", "--seconds", "5", "--json").json["parameters"]["mass"]
    assert again["std"] < 0.1 * made["parameters"]["mass"]["std"]
    csv = grounded("-C", w, "export", made["candidate"], "-o", tmp_path / "drive.csv")
    assert csv.code == 0 and (tmp_path / "drive.csv").read_text().count("\n") > 100


CERTAIN = MODEL.replace(', "kg", 0.1, 10.0', "").replace(', "N s/m", 0.0, 5.0', "")
STUCK = MODEL.replace("a.force", "0.0 * a.force")


@pytest.mark.parametrize(
    ("files", "seconds", "code"),
    [
        ({"config": BARE}, None, "plan.no_drive"),
        ({"config": SAFE.replace("force = [-5.0, 5.0]", "")}, None, "plan.no_limits"),
        ({"config": SAFE, "model": CERTAIN}, None, "given.constant"),
        ({"config": SAFE, "model": STUCK}, None, "plan.without_effect"),
        ({"config": SAFE}, 0.01, "given.value"),
        ({"config": SAFE + "v = [0.5, 0.6]\n"}, None, "plan.no_drive"),
    ],
)
def test_what_is_missing_is_told(tmp_path, files, seconds, code):
    w = Workspace(make(tmp_path / "w", **files).folder)
    with pytest.raises(GroundedError) as refused:
        w.excite(seconds)
    assert refused.value.finding.code == code
