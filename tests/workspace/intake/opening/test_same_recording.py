"""A file that holds a recording which is stored already, whole or in part, is no second trial."""

import numpy as np
import pytest

from cli import grounded
from facts import holding
from grounded.errors import GroundedError
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.ingest import ingest_log
from workspaces import make

TABLE = """
[log.state]
x = { path = "/csv.x" }
v = { path = "/csv.v" }

[log.input]
force = { path = "/csv.force" }
"""
STAMP = 1_700_000_000.0


@pytest.fixture
def w(tmp_path):
    return make(tmp_path / "w")


def log(path, rows=slice(None), start=0.0, seed=0, scale=1.0):
    """A log of the cart as a table: some rows of it, with the noise of one run."""
    t = np.arange(0, 4, 0.02)
    noise = 0.001 * np.random.default_rng(seed).normal(size=(2, len(t)))
    force = np.sin(3 * np.floor(t / 0.06))
    table = np.column_stack(
        [t + start, scale * (np.sin(t) + noise[0]), np.cos(t) + noise[1], force]
    )
    np.savetxt(path, table[rows], "%.6f", ",", header="t,x,v,force", comments="")
    return path


def mapped(w, text=TABLE):
    file = w.folder / "grounded.toml"
    file.write_text(file.read_text() + text)
    return w


def test_what_is_left_of_a_stored_log_is_that_trial(w, tmp_path, start=STAMP):
    mapped(w)
    first = ingest_log(w, log(tmp_path / "a.csv", start=start), data=True)
    for rows in (slice(0, 120), slice(0, 60)):
        again = ingest_log(w, log(tmp_path / "b.csv", rows, start), data=True)
        assert (again.trial, again.known) == (first.trial, True) and len(w.trials()) == 1
        assert any(first.trial in note for note in again.notes)
    other = ingest_log(w, log(tmp_path / "c.csv", slice(0, 120), start, seed=1), data=True)
    assert other.trial != first.trial and not other.known


def test_the_rest_of_a_part_that_is_stored_asks_to_discard_that(w, tmp_path):
    mapped(w)
    first = ingest_log(w, log(tmp_path / "a.csv", slice(0, 120)), data=True).trial
    with pytest.raises(GroundedError, match=holding(first, "discard")) as refused:
        ingest_log(w, log(tmp_path / "b.csv"), data=True)
    assert refused.value.then.arguments == (first,) and len(w.trials()) == 1


def test_the_same_stamps_through_another_table_are_refused(w, tmp_path):
    mapped(w)
    first = ingest_log(w, log(tmp_path / "a.csv", start=STAMP), data=True).trial
    part = log(tmp_path / "b.csv", slice(0, 120), STAMP, scale=2.0)
    with pytest.raises(GroundedError, match=holding(first, "another way")):
        ingest_log(w, part, data=True)
    assert grounded("-C", w.folder, "discard", first).code == 0
    assert not ingest_log(Folder(w.folder), part, data=True).known
