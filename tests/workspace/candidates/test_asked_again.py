"""A run that costs the best candidate its place is told as one more run of it."""

from dataclasses import replace

import numpy as np
import pytest

from grounded_trials.store.trial_file import read_trial, write_trial
from grounded_trials.workspace.candidates.proposing import propose_in
from grounded_trials.workspace.candidates.running import run_candidate
from grounded_trials.workspace.candidates.search_state import standing_in
from grounded_trials.workspace.intake.ingest import ingest_log
from workspaces import make


@pytest.fixture
def doubtful(tmp_path):
    """A workspace whose c0002 lost by what may be bad luck: c0001 was handed out to run again."""
    w = make(tmp_path / "w")
    best, *_ = read_trial(run_candidate(w, propose_in(w).candidate.id).trial_file)
    ingest_log(w, w.folder / "runs" / "c0001-1.mcap")
    second = propose_in(w).candidate.id
    lost, *_ = read_trial(run_candidate(w, second).trial_file)
    cost = -w.task.utility(best)

    def worse(by):
        """Write a run of c0002 that lost by this share of the best cost; return its file."""
        low, high = 0.0, 1.0
        for _ in range(50):
            off = np.zeros_like(lost.states)
            off[1:, 0] = 0.5 * (low + high)
            run = replace(lost, states=lost.states + off)
            too_much = -w.task.utility(run) > (1 + by) * cost
            low, high = (low, off[1, 0]) if too_much else (off[1, 0], high)
        path = tmp_path / f"lost-{by}.mcap"
        write_trial(path, run, {"kind": "trial"})
        return path

    w.worse, w.best, w.unnamed = worse, best, tmp_path / "unnamed.mcap"
    ingest_log(w, worse(0.8), second)
    again = propose_in(w)
    assert again.candidate.id == "c0001" and not again.proposal.is_new
    return w


def test_a_run_that_costs_the_best_its_place_is_told_as_one_more_run_of_it(doubtful):
    states = doubtful.best.states.copy()
    states[1:, 0] += 5.0
    write_trial(doubtful.unnamed, replace(doubtful.best, states=states), {"kind": "trial"})
    found = ingest_log(doubtful, doubtful.unnamed, "c0001")
    assert (found.candidate, found.verdict) == ("c0001", "run again")
    assert standing_in(doubtful).incumbent.candidate.id == "c0002"
