"""A program that once acted on older samples than in the runs before, at the right time."""

import pytest

from cli import grounded, plain
from facts import holds
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.remarks.control_loop import _steps_old
from recorded import record, waiting


@pytest.mark.parametrize("before", [0.5, 0.0])
@pytest.mark.parametrize("old", [1, 2, 0])
def test_samples_that_are_older_than_before_are_a_reason_to_run_it_again(tmp_path, before, old):
    """An aircraft's samples were 0.2 s old: a note, the run counted, and the model was given up."""
    w = waiting(tmp_path)
    policy = w.candidate("c0002")[0].policy
    log = record(w, tmp_path / "a.csv", policy, before, seed=4, old=old)
    out = grounded("-C", w.folder, "next", log)
    told = " ".join(plain(out.out + out.err).split())
    asked = holds(told, "ms old, at the present time; earlier runs acted on the newest")
    assert asked is (old > 0)
    assert ("discard t0002" in told) is (old > 0)
    if old:
        assert f"states that are {50 * old} ms old" in told and "run c0002 again" in told
    status = plain(grounded("-C", w.folder, "status").out)
    assert ("discard t0002" in status) is (old > 0)


def test_samples_that_are_as_old_in_every_run_are_the_robot_s(tmp_path):
    w = waiting(tmp_path)
    first = w.candidate("c0001")[0]
    trial = next(t.trial for t in w.trials() if t.trial.candidate == "c0001")
    assert _steps_old(first, trial) == 0
    grounded("-C", w.folder, "discard", "t0001")
    w.forget()
    log = record(w, tmp_path / "a.csv", first.policy, 0.0, seed=5, old=2)
    out = grounded("-C", w.folder, "ingest", log, "--candidate", "c0001")
    assert "earlier runs acted" not in " ".join(plain(out.out + out.err).split())
    kept = [t.trial for t in Folder(w.folder).trials() if t.trial.candidate == "c0001"]
    assert [_steps_old(first, one) for one in kept] == [2]
