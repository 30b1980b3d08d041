"""Tables whose times are in ms under a header that says seconds, and [log] without a signal."""

import numpy as np

from cli import grounded
from facts import of_code
from grounded_trials.starting.begin import begin


def table(path, column="t", seconds=1e-3):
    """20 s of a cart at 100 Hz, whose first row is at 0; times in units of `seconds`."""
    t = np.arange(2000) * 0.01
    u = np.where((t % 2) < 1, 1.0, -1.0)
    rows = np.column_stack([t / seconds, np.cumsum(u) * 0.01, u])
    np.savetxt(path, rows, "%.6g", ",", header=f"{column},v,force", comments="")
    return path


def test_times_in_ms_are_asked_about_and_next_is_to_begin_again(tmp_path):
    log = table(tmp_path / "a.csv")
    made = begin(tmp_path / "w", log, kind="generic", inputs=["force"])
    assert made.then.verb == "init" and made.then.arguments[0] == str(tmp_path / "w-2")
    assert not of_code(made, "file.odd_values")  # the row at 0 is no fault
    done = grounded("init", tmp_path / "v", "--from", log, "--inputs", "force", "--yes")
    told = " ".join(done.out.replace("\\\n", " ").split())
    assert f"init {tmp_path / 'v-2'} --from {log} --inputs force" in told.partition("next: ")[2]
    renamed = table(tmp_path / "b.csv", column="t_ms")
    again = begin(tmp_path / "w-2", renamed, kind="generic", inputs=["force"])
    assert again.dt < 2 and again.then.verb == "ingest"


def test_times_in_ms_since_1970_are_known_by_their_size_under_any_name(tmp_path):
    table(tmp_path / "a.csv", "time_s")
    rows = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1)
    rows[:, 0] += 1.764e12
    np.savetxt(tmp_path / "b.csv", rows, "%.1f", ",", header="time_s,v,force", comments="")
    assert begin(tmp_path / "w", tmp_path / "b.csv", kind="generic", inputs=["force"]).dt < 2


def test_a_model_that_no_input_moves_is_fitted_before_it_is_diagnosed(tmp_path):
    log = table(tmp_path / "b.csv", column="t_ms")
    begin(tmp_path / "w", log, kind="generic", inputs=["force"])
    done = grounded("-C", tmp_path / "w", "ingest", "--data", log)
    assert "fit --apply" in done.out.partition("next: ")[2]
