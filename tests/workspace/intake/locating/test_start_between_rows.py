"""When a run begins, to less than the time between the rows of a table that shows it."""

import numpy as np
import pytest

from facts import of_code
from recorded import RATE, record, rows_of, waiting, written


@pytest.fixture
def w(tmp_path):
    return waiting(tmp_path)


def test_rows_out_of_step_with_the_commands_tell_together_when_a_run_begins(w, tmp_path, row=0.011):
    policy = w.candidate("c0002")[0].policy
    path = record(w, tmp_path / "a.csv", policy, 0.8)
    table = rows_of(path)
    t = np.arange(table[0, 0] + 0.003, table[-1, 0], row)
    at = np.floor((t - table[0, 0]) * RATE + 1e-6).astype(int)
    rows = [t, *(np.interp(t, table[:, 0], table[:, k]) for k in (1, 2)), table[at, 3]]
    found = w.ingest(written(tmp_path / "b.csv", np.transpose(rows)))
    assert found.candidate == "c0002" and not of_code(found, "log.start_loose")
    begun = w.trials()[-1].meta["start_ns"]
    assert int(begun) * 1e-9 - table[0, 0] == pytest.approx(0.8, abs=0.0025)
