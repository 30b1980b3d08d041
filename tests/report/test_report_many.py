"""A report of many trials: bounded, the same numbers, and it says what it leaves out."""

from dataclasses import replace

import numpy as np
import pytest

from cli import grounded
from facts import holds
from grounded.search.pictures import few
from grounded_trials import Workspace
from grounded_trials.report import gathering
from grounded_trials.report.page import page
from grounded_trials.store.trial_file import write_trial
from reported import many_flights
from workspaces import make


@pytest.fixture(scope="module")
def learnt(tmp_path_factory):
    """A cart after its search, and five logs of data."""
    w = Workspace(make(tmp_path_factory.mktemp("many") / "w").folder)
    w.learn()
    first = w.trials()[0].trial
    for k in range(5):
        data = replace(first, states=first.states + 0.01 * k, candidate="")
        write_trial(w.folder / f"d{k}.mcap", data, {"kind": "data"})
        w.ingest(w.folder / f"d{k}.mcap", data=True)
    return w


def test_few_candidates_are_the_first_the_improvements_and_the_latest():
    history = many_flights(30).history
    assert few(history, 30) == (list(history), 0)
    shown, left = few(history, 8)
    assert len(shown) == 8 and left == 22
    assert shown[0] is history[0] and shown[-1] is history[-1]
    assert [t.candidate.id for t in shown] == sorted(t.candidate.id for t in shown)


def test_a_report_reads_few_of_many_trials_and_its_numbers_are_the_same(learnt, monkeypatch):
    whole = gathering.gather(learnt)
    for name, most in (("MOST_RUNS", 1), ("IMPROVEMENTS_READ", 2), ("LOGS", 2)):
        monkeypatch.setattr(gathering, name, most)
    part = gathering.gather(learnt)
    assert whole.left_runs == whole.left_logs == 0
    assert len(part.runs) < len(whole.runs) and len(part.logs) == 2
    assert part.left_runs == len(whole.runs) - len(part.runs)
    assert part.left_logs == len(whole.logs) - 2 == 3
    assert part.runs[-1].trial.id == whole.runs[-1].trial.id
    ends = [r.utility for r in whole.improvements]
    assert [r.utility for r in part.improvements] == [ends[0], ends[-1]] and len(ends) > 2
    for one, other in ((part.first, whole.first), (part.best, whole.best)):
        assert one.utility == other.utility
        np.testing.assert_array_equal(one.residual, other.residual)
    text = page(part)
    assert holds(text, f"{len(part.runs)} of {len(whole.runs)} trials", "2 of 5 logs")
    head = grounded("-C", learnt.folder, "report").out.splitlines()[0:3]
    assert f"{len(whole.runs)} trials" in " ".join(head)
