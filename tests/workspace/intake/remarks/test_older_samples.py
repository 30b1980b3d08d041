"""A program that once acted on older samples than in the runs before, at the right time."""

import pytest

from cli import grounded, plain
from facts import of_code
from grounded_trials import Workspace
from recorded import record, waiting


@pytest.mark.parametrize("old", [1, 0])
@pytest.mark.parametrize("before", [0.5])
def test_samples_that_are_older_than_before_are_a_reason_to_run_it_again(tmp_path, before, old):
    w = waiting(tmp_path)
    policy = w.candidate("c0002")[0].policy
    log = record(w, tmp_path / "a.csv", policy, before, seed=4, old=old)
    found = Workspace(w.folder).next(log).taken
    told = of_code(found, "run.older")
    assert [one.facts["age"].value for one in told] == [pytest.approx(0.05 * old)] * (old > 0)
    assert (found.then.verb == "discard") is (old > 0)
    status = plain(grounded("-C", w.folder, "status").out)
    assert ("discard t0002" in status) is (old > 0)
