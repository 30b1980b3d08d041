"""The candidate that a diagnosis offers next is one that `run` and `export` hand over."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.effects import Library
from grounded.errors import NextCommand
from grounded_trials import Workspace
from grounded_trials.workspace.candidates.handover import checked_candidate
from grounded_trials.workspace.last_diagnosis import read_diagnosis
from grounded_trials.workspace.next_step import to_run
from reported import copied
from workspaces import CONFIG, edit, make

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
