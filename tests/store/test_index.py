"""The index of a large store: the same answers, quickly; derived, checked and deletable."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from grounded.errors import GroundedError
from grounded_trials import Workspace
from grounded_trials.store.index import KnownTrial
from grounded_trials.store.trial_file import trial_bytes
from grounded_trials.workspace import folder as folder_module
from workspaces import CONFIG, make

COUNT = 130


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A search with hundreds of repeats and logs of data, one with gaps, one that ended early."""
    config = CONFIG.replace("max_trials = 12", "max_trials = 1000")
    w = Workspace(make(tmp_path_factory.mktemp("index") / "w", config=config).folder)
    w.learn(3)
    rng, ran = np.random.default_rng(0), w.trials()
    for k in range(len(ran), COUNT):
        one = ran[k % len(ran)]
        states = one.trial.states + rng.normal(0, 1e-3, one.trial.states.shape)
        if k == 50:
            states[10:12] = np.nan
        trial = replace(one.trial, states=states, candidate="" if k % 2 else one.trial.candidate)
        trial = trial.until(20) if k == 60 else trial
        meta = {key: one.meta[key] for key in ("kind", "iteration", "alpha", "task")}
        data = trial_bytes(trial, meta, policy=None if k % 2 else one.policy)
        name = f"t{k + 1:04d}-{hashlib.sha256(data).hexdigest()[:16]}.mcap"
        (w.store.folder / name).write_bytes(data)
    return w


@pytest.fixture
def indexed(made, monkeypatch):
    """Small enough for a test, large enough for the index."""
    monkeypatch.setattr(folder_module, "INDEXED_FROM", 100)
    file = made.store.folder / ".index.json"
    file.unlink(missing_ok=True)
    return made, file


def plainly(made, monkeypatch):
    monkeypatch.setattr(folder_module, "INDEXED_FROM", 10**6)
    return Workspace(made.folder)


@pytest.mark.slow
def test_the_index_changes_no_answer(indexed, monkeypatch):
    w, file = indexed
    first = Workspace(w.folder).status().to_json()
    assert file.is_file()
    again = Workspace(w.folder)
    assert again.status().to_json() == first
    known = again.trials()
    plain = plainly(w, monkeypatch)
    assert plain.status().to_json() == first
    assert sum(isinstance(t.trial, KnownTrial) for t in known) == COUNT - 1
    for one, other in zip(known, plain.trials(), strict=True):
        for a, b in ((one.trial, other.trial), (one.measured, other.measured)):
            about = ("id", "candidate", "dt", "state_names", "steps", "finite_steps", "known_steps")
            assert all(getattr(a, name) == getattr(b, name) for name in about)
            np.testing.assert_array_equal(a.states, b.states)
            np.testing.assert_array_equal(a.inputs, b.inputs)
        assert (one.meta, one.ran, one.policy) == (other.meta, other.ran, other.policy)


@pytest.mark.parametrize("how", ["half", "flipped", "directory"])
def test_an_index_that_is_damaged_is_made_again(indexed, how):
    w, file = indexed
    answer = Workspace(w.folder).status().to_json()
    data = file.read_bytes()
    file.unlink()
    if how == "directory":
        file.mkdir()
    else:
        flipped = data.replace(b'"steps": 40', b'"steps": 20')
        file.write_bytes({"half": data[:9000], "flipped": flipped}[how])
    assert Workspace(w.folder).status().to_json() == answer
    if how == "directory":
        file.rmdir()


def test_a_trial_that_was_damaged_behind_the_index_is_found(indexed):
    w, _ = indexed
    Workspace(w.folder).status()
    (path,) = w.store.folder.glob("t0100-*")
    data = path.read_bytes()
    path.chmod(0o644)
    path.write_bytes(data[:900] + bytes([data[900] ^ 1]) + data[901:])
    try:
        with pytest.raises(GroundedError, match="t0100"):
            Workspace(w.folder).status()
    finally:
        path.write_bytes(data)
    assert Workspace(w.folder).status().standing.trials > COUNT // 3


@pytest.mark.parametrize("how", ["flipped", "another's", "gone"])
def test_a_candidate_that_was_changed_behind_the_index_is_found(indexed, how):
    w, _ = indexed
    answer = Workspace(w.folder).status().to_json()
    path, other = (w.candidate_path(name) for name in ("c0002", "c0003"))
    data = path.read_bytes()
    path.unlink()
    if how != "gone":
        flipped = data[:900] + bytes([data[900] ^ 1]) + data[901:]
        path.write_bytes(flipped if how == "flipped" else other.read_bytes())
    try:
        if how == "gone":  # a trial carries it
            assert Workspace(w.folder).status().to_json() == answer
        else:
            with pytest.raises(GroundedError, match="c0002"):
                Workspace(w.folder).status()
            assert Workspace(w.folder).verify().damaged
    finally:
        path.write_bytes(data)
    assert Workspace(w.folder).status().to_json() == answer
