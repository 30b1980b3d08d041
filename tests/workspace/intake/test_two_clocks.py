"""A motion capture and a robot's program, each with its own clock, in one log."""

import re
from pathlib import Path

import numpy as np
import pytest

from facts import holding
from grounded.errors import GroundedError
from grounded_trials import Workspace
from recorded import LOGGED, record
from workspaces import make

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
