"""Times in ms under a header of seconds, and the interval at which commands change."""

import numpy as np
import pytest

from cli import grounded
from facts import of_code
from grounded_trials.starting.begin import begin
from grounded_trials.starting.interval import changes_every

MODEL = """from grounded import Model, Param

model = Model(
    states={"x": "m", "v": "m/s"},
    inputs={"force": "N"},
    params={"drag": Param(0.5, "1/s", 0.0, 5.0)},
    derivative=lambda s, a, p: {"x": s.v, "v": a.force - p.drag * s.v},
)
"""


def gaps(every, rows, seed=0, jitter=0.0, drift=0.0, held=0.3, odd=0):
    """Times between changes of a command that a loop sends, as rows of a log show them."""
    rng = np.random.default_rng(seed)
    t = every * (1 + drift) * np.arange(600) + rng.normal(0, jitter, 600) + 0.37 * rows
    t = t[rng.random(600) > held]  # at times it stays as it was
    t = np.concatenate([t, rng.uniform(0, t[-1], odd)])
    return np.diff(np.unique(np.ceil(t / rows)) * rows)


@pytest.mark.parametrize(
    "every, rows, more",
    [
        (0.05, 0.01, {}),
        (0.05, 0.01, {"jitter": 0.002}),
        (0.05, 0.001, {"jitter": 0.001}),
        (0.05, 0.01, {"drift": 1e-3}),  # clocks of two computers
        (0.05, 0.01, {"odd": 4}),
        (0.05, 0.01, {"held": 0.6}),
        (0.02, 0.005, {}),
        (0.1, 0.01, {}),
        (0.1, 0.02, {"jitter": 0.003}),
        (0.02, 0.01, {}),
        (0.02, 0.01, {"held": 0.0}),  # not 0.025 s, of which it is within a row
        (0.02, 0.005, {"held": 0.0}),
        (0.0333333, 0.005, {"jitter": 0.001}),
        (0.0166667, 0.002, {}),
        (0.008, 0.002, {}),  # not 0.00833333 s, of which it is within a row
        (0.00833333, 0.002, {}),
        (0.01, 0.005, {"jitter": 0.0007, "held": 0.0}),  # a quarter of the gaps is 5 ms, or 15
        (0.01, 0.005, {"jitter": 0.0007, "held": 0.0, "drift": 3e-4}),
    ],
)
def test_the_interval_is_found_in_what_rows_show(every, rows, more):
    assert changes_every(gaps(every, rows, **more), rows) == every


def table(path, every):
    """A run of 20 s, a row every 10 ms, whose command changes every so many rows."""
    rng, t = np.random.default_rng(1), np.arange(2000) * 0.01
    force = np.repeat(np.round(rng.normal(0, 1, 2000 // every), 3), every)
    v = np.cumsum(force) * 0.01
    columns = np.column_stack([t, np.cumsum(v) * 0.01, v, force])
    np.savetxt(path, columns, "%.5f", ",", header="t,x,v,force", comments="")
    return path


@pytest.mark.parametrize("every, dt", [(5, 0.05), (1, 0.01)])
def test_a_table_of_rows_more_frequent_than_commands_has_the_commands_interval(tmp_path, every, dt):
    (tmp_path / "m.py").write_text(MODEL)
    found = begin(tmp_path / "w", table(tmp_path / "r.csv", every), model=tmp_path / "m.py")
    assert found.dt == dt
    assert 'seen_in = "r.csv"' in (tmp_path / "w/grounded.toml").read_text()
    assert bool(of_code(found, "start.interval")) == (every == 5)


def in_ms(path, column="t", seconds=1e-3):
    """20 s of a cart at 100 Hz, whose first row is at 0; times in units of `seconds`."""
    t = np.arange(2000) * 0.01
    u = np.where((t % 2) < 1, 1.0, -1.0)
    rows = np.column_stack([t / seconds, np.cumsum(u) * 0.01, u])
    np.savetxt(path, rows, "%.6g", ",", header=f"{column},v,force", comments="")
    return path


def test_times_in_ms_are_asked_about_and_next_is_to_begin_again(tmp_path):
    log = in_ms(tmp_path / "a.csv")
    made = begin(tmp_path / "w", log, kind="generic", inputs=["force"])
    assert made.then.verb == "init" and made.then.arguments[0] == str(tmp_path / "w-2")
    assert not of_code(made, "file.odd_values")  # the row at 0 is no fault
    done = grounded("init", tmp_path / "v", "--from", log, "--inputs", "force", "--yes")
    told = " ".join(done.out.replace("\\\n", " ").split())
    assert f"init {tmp_path / 'v-2'} --from {log} --inputs force" in told.partition("next: ")[2]
    renamed = in_ms(tmp_path / "b.csv", column="t_ms")
    again = begin(tmp_path / "w-2", renamed, kind="generic", inputs=["force"])
    assert again.dt < 2 and again.then.verb == "ingest"


def test_times_in_ms_since_1970_are_known_by_their_size_under_any_name(tmp_path):
    in_ms(tmp_path / "a.csv", "time_s")
    rows = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1)
    rows[:, 0] += 1.764e12
    np.savetxt(tmp_path / "b.csv", rows, "%.1f", ",", header="time_s,v,force", comments="")
    assert begin(tmp_path / "w", tmp_path / "b.csv", kind="generic", inputs=["force"]).dt < 2


def test_a_model_that_no_input_moves_is_fitted_before_it_is_diagnosed(tmp_path):
    log = in_ms(tmp_path / "b.csv", column="t_ms")
    begin(tmp_path / "w", log, kind="generic", inputs=["force"])
    done = grounded("-C", tmp_path / "w", "ingest", "--data", log)
    assert "fit --apply" in done.out.partition("next: ")[2]
