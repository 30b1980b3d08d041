"""A run that its log hides behind zeros, limits or a second clock is told by its cause."""

import re
from pathlib import Path

import numpy as np
import pytest

from cli import grounded
from facts import holding, holds, of_code
from grounded.errors import GroundedError, NextCommand
from grounded_trials import Workspace
from recorded import LOGGED, record, rows_of, waiting, written
from workspaces import make


@pytest.fixture
def w(tmp_path):
    """It waits for c0002; c0001 was run."""
    return waiting(tmp_path)


def refused(w, log):
    with pytest.raises(GroundedError) as error:
        w.ingest(log)
    return error.value


def test_a_state_from_another_zero_is_named_with_the_offset(w, tmp_path, by=-0.4):
    run = record(w, tmp_path / "a.csv", w.candidate("c0002")[0].policy, 1.0, noise=(2e-4, 1e-3))
    one = refused(w, written(run, rows_of(run) + np.array([0, by, 0, 0]))).finding
    assert (one.code, one.about) == ("log.zero", ("x",))
    told = one.facts["add"]
    assert told == pytest.approx(-by, abs=0.02)
    toml = w.folder / "grounded.toml"
    toml.write_text(
        toml.read_text().replace('path = "/csv.x"\n', f'path = "/csv.x"\noffset = {told}\n')
    )
    assert Workspace(w.folder).ingest(run).candidate == "c0002"


def test_a_log_without_the_run_s_beginning_says_so(w, tmp_path):
    run = record(w, tmp_path / "a.csv", w.candidate("c0002")[0].policy, 0.0)
    lines, dt = run.read_text().splitlines(), w.task.dt
    times = np.array([float(line.split(",")[0]) for line in lines[1:]])
    rows = round(8 * dt / float(np.median(np.diff(times))))
    run.write_text("\n".join([lines[0], *lines[1 + rows :]]))
    error = refused(w, run)
    assert error.finding.code == "log.begun_late"
    assert error.then.arguments == ("LOG",)  # this one would be refused again
    assert error.finding.facts["late"].value == pytest.approx(8 * dt, abs=1.01 * dt)


def test_columns_that_no_command_depends_on_are_not_called_exchanged(tmp_path):
    w = waiting(tmp_path, LOGGED.replace("[task]\n", "[task]\nfeedback = false\n"))
    ran = w.candidate("c0002")[0].policy
    w.ingest(record(w, tmp_path / "a.csv", ran, 0.0))
    waits = w.propose().candidate
    assert waits.policy.gain is None
    off = np.std(waits.policy.feedforward - ran.feedforward)
    assert 1e-3 < off < 0.1 * np.abs(ran.feedforward).max()
    found = w.ingest(record(w, tmp_path / "b.csv", ran, 0.0, seed=1), candidate=waits.id)
    (told,) = of_code(found, "log.another", "log.exchange", "log.not_run")
    assert (told.code, told.facts["other"]) == ("log.another", "c0002")


def test_that_a_log_of_unknown_start_is_longer_than_a_run_is_told(w, tmp_path):
    path = record(w, tmp_path / "a.csv", w.candidate("c0002")[0].policy, 3.0)
    t, none = rows_of(path)[:, 0], np.zeros(len(rows_of(path)))
    written(path, np.column_stack([t, none, none, 0.01 * np.sin(20 * (t - t[0]))]))
    (told,) = of_code(w.ingest(path, candidate="c0002"), "log.start_assumed")
    assert told.facts["longer"] > 0


def test_a_speed_that_stays_at_zero_is_the_reason_that_is_given(w, tmp_path):
    run = record(w, tmp_path / "a.csv", w.candidate("c0002")[0].policy, 0.0)
    one = refused(w, written(run, rows_of(run) * [1, 1, 0, 1])).finding
    assert (one.code, one.about) == ("log.dead", ("v",))


def test_a_candidate_of_an_earlier_task_is_found(w, tmp_path):
    run = record(w, tmp_path / "a.csv", w.candidate("c0002")[0].policy, 0.5)
    toml = w.folder / "grounded.toml"
    written = toml.read_text()
    toml.write_text(written.replace("[reward]\n", "[reward]\nterminal = { x = 0.5 }\n", 1))
    assert toml.read_text() != written and "terminal" not in written  # the task changes
    w = Workspace(w.folder)
    own = w.propose().candidate
    error = refused(w, run)
    assert holds(str(error), "ran c0002", "earlier task", "another target, reward", "--data")
    assert error.then == NextCommand("ingest", (str(run), "--data"))
    done = grounded("-C", w.folder, "ingest", run, "--data")
    assert done.code == 0, done.err
    fresh = record(w, tmp_path / "b.csv", own.policy, 0.5, seed=5)
    assert w.ingest(fresh, candidate=own.id).candidate == own.id


def test_limits_that_were_changed_since_the_export_are_named(w, tmp_path):
    run = record(w, tmp_path / "a.csv", w.candidate("c0002")[0].policy, 0.5)
    low, high = w.task.low[0], w.task.high[0]
    toml = w.folder / "grounded.toml"
    written = toml.read_text()
    toml.write_text(re.sub(r"(?m)^force = \[.*\]", f"force = [{0.8 * low}, {high}]", written))
    error = refused(Workspace(w.folder), run)
    assert holds(str(error), "ran c0002", f"limits of force: [{low:g}, {high:g}] then", "back")
    toml.write_text(written)
    assert Workspace(w.folder).ingest(run).candidate == "c0002"


SPLIT = LOGGED.replace("/csv.force", "/cmd.force").replace("/csv.", "/mocap.")
APART = 8134.22  # [s] by which the cameras' clock is ahead


def two_tables(w, path, policy, apart):
    """A run as an NPZ of two tables: what the cameras saw, and what the program sent."""
    rows = np.loadtxt(record(w, path.with_suffix(".csv"), policy, 0.0), delimiter=",", skiprows=1)
    t, states, force = rows[:, 0] - rows[0, 0], rows[:, 1:3], rows[:, 3]
    sent = slice(None, None, round(policy.dt / (t[1] - t[0])))
    np.savez(
        path,
        mocap=states,
        mocap_t=t + apart,
        mocap_names=np.array(["x", "v"]),
        cmd=force[sent, None],
        cmd_t=t[sent],
        cmd_names=np.array(["force"]),
    )
    return path


def test_two_clocks_are_told_with_the_lines_that_bridge_them(tmp_path, apart=-APART):
    config = SPLIT
    w = Workspace(make(tmp_path / "w", config=config).folder)
    ran = w.propose().candidate
    log = two_tables(w, tmp_path / "run.npz", ran.policy, apart)
    for how in ({"data": True}, {}):
        with pytest.raises(GroundedError, match="differ by about") as refused:
            w.ingest(log, **how)
    lines = dict(re.findall(r"\[log\.state\.(\w)\] (delay_s = -?\d+\.\d+)", str(refused.value)))
    assert list(lines) == ["x", "v"]
    for name, line in lines.items():
        assert float(line.split()[-1]) == pytest.approx(apart, abs=0.02)
        config = config.replace(f'"/mocap.{name}"', f'"/mocap.{name}"\n{line}')
    (w.folder / "grounded.toml").write_text(config)
    found = Workspace(w.folder).ingest(log)  # the program was no 8134 s late
    assert found.candidate == ran.id


def test_the_lines_of_the_docs_make_one_log_of_two_tables(tmp_path, monkeypatch):
    w = Workspace(make(tmp_path / "w", config=SPLIT).folder)
    ran = w.propose().candidate
    rows = np.loadtxt(record(w, tmp_path / "a.csv", ran.policy, 0.0), delimiter=",", skiprows=1)
    (tmp_path / "run").mkdir()
    monkeypatch.chdir(tmp_path / "run")
    for name, columns, head in (("mocap", (0, 1, 2), "time,x,v"), ("cmd", (0, 3), "t,force")):
        np.savetxt(f"{name}.csv", rows[:, columns], "%.5f", ",", header=head, comments="")
    with pytest.raises(GroundedError, match=holding("cmd.csv and mocap.csv", ".npz")):
        w.ingest(tmp_path / "run")
    docs = Path(__file__).parents[3] / "docs/log-reference.md"
    (lines,) = re.findall(r"```python\n(.*?np\.savez.*?)```", docs.read_text(), re.DOTALL)
    exec(compile(lines, str(docs), "exec"), {})
    assert w.ingest(tmp_path / "run/run.npz").candidate == ran.id
