"""Where a run begins whose first commands were not the policy's: two steps late it looked as good.

An arm's loop swung its torques from step to step. Its program missed step 0, and made the next few
of what it had: the mean of all differences put the start 20 ms late, and its utility was another's.
"""

import numpy as np
import pytest

from facts import of_code
from grounded_trials import Workspace
from grounded_trials.workspace.intake.opening import run_start
from recorded import RATE, record, rows_of, waiting, written


@pytest.fixture
def w(tmp_path):
    return waiting(tmp_path)


def run(w, path, policy, strange, before=1.0):
    """The log of a run, its first commands `strange`, not the policy's; each with its own stamp."""
    record(w, path, policy, before)
    table = rows_of(path)
    every, first = round(policy.dt * RATE), round(before * RATE)
    for k, force in enumerate(strange):
        table[first + k * every : first + (k + 1) * every, 3] = force
    table[(np.arange(len(table)) - first) % every != 0, 3] = np.nan
    return written(path, table)


def unsent(w, path, policy, missed):
    """The log of a run of which the first steps were never sent, nor anything before."""
    run(w, path, policy, ())
    table = rows_of(path)
    table[: round((1.0 + missed * policy.dt) * RATE), 3] = np.nan
    return written(path, table)


@pytest.mark.parametrize("missed", [0, 2])
def test_a_run_whose_first_steps_were_not_sent_begins_before_its_first_command(w, tmp_path, missed):
    policy = w.candidate("c0002")[0].policy
    found = w.ingest(unsent(w, tmp_path / "a.csv", policy, missed))
    told = of_code(found, "run.missed")
    assert found.candidate == "c0002" and len(told) == bool(missed)
    assert all(one.facts["steps"] == missed for one in told)
    assert not of_code(found, "log.gaps", "log.late")
    stored = w.trials()[-1]
    assert int(stored.meta["start_ns"]) * 1e-9 == pytest.approx(1001.0, abs=0.2 / RATE)
    np.testing.assert_array_equal(stored.trial.inputs[:missed, 0], w.task.past[0])
    np.testing.assert_array_equal(stored.trial.inputs[missed:, 0] != 0, True)


def test_a_log_that_was_stored_a_step_late_is_another_trial_once_that_is_discarded(
    w, tmp_path, monkeypatch
):
    log = unsent(w, tmp_path / "a.csv", w.candidate("c0002")[0].policy, 1)
    with monkeypatch.context() as before:
        before.setattr(run_start.Recording, "_before_first", lambda *_: None)
        late = w.ingest(log, candidate="c0002")
    w.discard(late.trial)
    found = w.ingest(log)
    assert found.candidate == "c0002" and found.trial != late.trial and not found.known


def test_a_run_whose_first_commands_were_not_sent_is_its_candidate_s(w, tmp_path):
    log = run(w, tmp_path / "a.csv", w.candidate("c0002")[0].policy, (-5.0, -4.9))
    toml = w.folder / "grounded.toml"
    toml.write_text(toml.read_text() + "[log.span]\nstart = 1.0\n")
    w = Workspace(w.folder)
    found = w.ingest(log)
    assert found.candidate == "c0002" and not of_code(found, "log.not_run")
    begun = int(w.trials()[-1].meta["start_ns"]) * 1e-9
    assert begun == pytest.approx(1001.0, abs=0.2 / RATE)
