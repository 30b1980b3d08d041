"""The control interval is that in which commands change, where rows are more frequent."""

import numpy as np
import pytest

from facts import holds
from grounded_trials.logs.command_steps import changes_of, phase_of
from grounded_trials.starting.begin import begin
from grounded_trials.starting.interval import changes_every, round_interval

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


@pytest.mark.parametrize(
    "times",
    [
        np.full(2000, 0.01),  # every row
        np.full(40, 1.0),  # a test signal's steps
        np.full(15, 0.05),  # too few
        np.round(np.random.default_rng(0).exponential(0.08, 500) + 0.01, 2),  # whenever
        np.tile([0.05, 0.05, 0.06, 0.08], 30),
        0.02 + np.random.default_rng(0).choice([-0.005, 0.0, 0.0, 0.005], 400),  # in no step
    ],
)
def test_what_no_interval_explains_has_none(times):
    assert changes_every(times, 0.01) is None


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
    assert any("0.05 s" in note for note in found.notes) == (every == 5)
    given = begin(tmp_path / "g", tmp_path / "r.csv", model=tmp_path / "m.py", dt=0.02)
    told = [note for note in given.notes if "--dt" in note]
    assert given.dt == 0.02 and len(told) == (every == 1)  # else each command has its steps
    assert all(holds(one, "10 ms", "20 ms", "one in 2", "--dt 0.01") for one in told)


@pytest.mark.parametrize("jitter", [0.0, 0.0003])
def test_changes_that_rows_show_late_tell_their_phase_together(jitter):
    rng = np.random.default_rng(0)
    rows = np.arange(0, 4, 0.010) + jitter * rng.standard_normal(400)
    sent = 0.0173 + 0.025 * np.arange(150)
    values = np.searchsorted(sent, rows, "right").astype(float)
    at, late = changes_of(np.round(rows * 1e9).astype(np.int64), values)
    phase, room = phase_of(at * 1e-9, 0.025, late * 1e-9)
    assert phase - room - 5e-4 < 0.0173 - 0.025 < phase + 5e-4 and room < 0.0055


def test_changes_at_any_time_are_in_no_step():
    rng = np.random.default_rng(1)
    rows = np.arange(0, 20, 0.010)
    values = np.searchsorted(np.sort(rng.uniform(0, 20, 300)), rows, "right").astype(float)
    at, late = changes_of(np.round(rows * 1e9).astype(np.int64), values)
    assert phase_of(at * 1e-9, 0.025, late * 1e-9) is None


@pytest.mark.parametrize("hz", [2, 7.5, 12, 15, 24, 25, 30, 45, 50, 60, 75, 90, 100, 120, 125, 144])
def test_the_interval_of_a_loop_is_that_of_its_rows(hz):
    assert round_interval(1 / hz) == pytest.approx(1 / hz, rel=3e-3)


def test_jitter_does_not_make_an_odd_interval():
    assert [round_interval(0.0333333 * off) for off in (0.98, 1.0, 1.02)] == [0.0333333] * 3
    assert round_interval(0.0303) == pytest.approx(1 / 33, rel=1e-5)
    assert (round_interval(1e-5), round_interval(90.0)) == (0.001, 90.0)
    assert [round_interval(rows) for rows in (0.996, 1.999, 2.5, 10.02)] == [1.0, 2.0, 2.5, 10.0]
