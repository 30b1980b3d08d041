"""One name, one policy; and `verify` proves the whole workspace.

What was measured on 0.1: a rewritten candidate was sent and `verify` was clean, joined workspaces
averaged two policies called c0002, one bit in diagnosis.json was adopted as 9.54 for 1.54 (1,539 of
6,000 flips silent), a slow `propose` replaced a candidate that was handed out.
"""

import shutil

import pytest

from facts import holding
from grounded.errors import GroundedError
from grounded_trials import Workspace
from grounded_trials.store.documents import read_document
from grounded_trials.workspace.last_diagnosis import read_diagnosis
from reported import copied
from workspaces import CONFIG, make


def learnt(folder, trials=2, **files):
    w = Workspace(make(folder, **files).folder)
    w.learn(trials)
    return w


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return learnt(tmp_path_factory.mktemp("identity") / "w")


@pytest.fixture
def w(made, tmp_path):
    return Workspace(shutil.copytree(made.folder, tmp_path / "w"))


def test_every_flipped_bit_of_a_diagnosis_is_found(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    w = Workspace(folder)
    path = folder / "reports" / "diagnosis.json"
    data, silent = path.read_bytes(), 0
    assert read_diagnosis(w.reports) is not None
    for bit in range(0, 8 * len(data), 31):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        try:
            read_document(path)
            silent += 1
        except GroundedError:
            pass
    assert silent == 0 and len(data) > 1500
    path.write_bytes(data[:700] + bytes([data[700] ^ 4]) + data[701:])
    assert [one.file for one in w.verify().damaged] == [str(path)]
    with pytest.raises(GroundedError, match="diagnose again"):
        w.adopt("viscous_friction:v")


def test_a_diagnosis_without_a_checksum_is_not_adopted(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    path = folder / "reports" / "diagnosis.json"
    text = path.read_text()
    path.write_text("{" + text.split(",", 1)[1])
    with pytest.raises(GroundedError, match=holding("diagnosis.json", "checksum")):
        Workspace(folder).adopt("viscous_friction:v")


def test_a_deleted_trial_is_found_the_last_one_too(w, which=-1):
    w.propose()  # this hand-out has seen the last trial
    trials = sorted(w.store.folder.glob("t*.mcap"))
    assert w.verify().damaged == ()
    trials[which].unlink()
    (found,) = w.verify().damaged
    assert "was removed" in found.reason
    assert w.report().findings.lost


def test_a_deleted_candidate_is_found_unless_a_trial_carries_it(w):
    waiting = w.propose().candidate.id
    w.candidate_path("c0001").unlink()
    assert w.verify().damaged == ()
    w.candidate_path(waiting).unlink()
    (found,) = w.verify().damaged
    assert waiting in found.file


def test_joined_workspaces_never_mix_two_policies_of_one_name(w, tmp_path):
    config = CONFIG.replace("max_trials", "refit = true\nmax_trials")  # the same task
    other = learnt(tmp_path / "other", config=config)
    assert other.task.hash == w.task.hash
    assert other.candidate_bytes("c0002") != w.candidate_bytes("c0002")
    before = w.status()
    for path in (other.folder / "trials").iterdir():
        if not (w.store.folder / path.name).exists():
            shutil.copy(path, w.store.folder)
    now = w.status()
    tried = now.standing.history[1]
    assert len(tried.trials) == 1 and tried.utility == before.standing.history[1].utility
    assert len(w.trials()) > len(before.standing.history)
    (name,) = {t.trial.candidate for t in w.trials() if "~" in t.trial.candidate}
    assert name.startswith("c0002~")
    assert "search.uncounted" in {one.code for one in now.findings}
    assert w.verify().damaged == ()
    w.candidate_path("c0002").unlink()  # and the first that ran it has the name
    assert len(w.status().standing.history[1].trials) == 1


def test_a_slow_propose_does_not_replace_what_was_handed_out(w, monkeypatch):
    from grounded.search import improve

    plan, quick = improve.propose, []

    def slow(*args, **kwargs):
        proposal = plan(*args, **kwargs)
        if not quick:  # somebody else proposes while this one plans
            quick.append(True)
            other = Workspace(w.folder)
            quick.append(other.propose().candidate.id)
            quick.append(other.candidate_bytes(quick[1]))
        return proposal

    monkeypatch.setattr(improve, "propose", slow)
    mine = w.propose()
    assert mine.candidate.id == quick[1] and not mine.proposal.is_new
    assert w.candidate_bytes(quick[1]) == quick[2] and w.verify().damaged == ()


def test_what_a_bare_trial_ran_is_kept_beside_it(w, tmp_path):
    from grounded_trials.store.trial_file import read_trial, write_trial

    ran = w.run(w.propose().candidate.id)
    trial, meta, _ = read_trial(ran.trial_file)
    write_trial(tmp_path / "bare.mcap", trial, {"kind": "trial", "task": meta["task"]})
    found = w.ingest(tmp_path / "bare.mcap")
    assert w.noted.ran.keys() == {found.sha256[:16]}
