"""Tables without names or times: `--columns` and `--rate`, given once and kept in [log]."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from cli import grounded
from facts import holding
from grounded.errors import GroundedError
from grounded_trials import Workspace
from grounded_trials.formats.tables import Layout
from grounded_trials.logs.inspection.inspect_log import inspect_log
from grounded_trials.logs.signals import SignalSpec, read_signals

N, RATE = 300, 50.0
LAYOUT = Layout(("w", "u_cmd"), RATE)


def rows(seed: int = 0) -> np.ndarray:
    """A motor's speed that follows its command with a lag of 0.3 s and a gain of 2."""
    t = np.arange(N) / RATE
    u = np.sign(np.sin((2 + seed) * t)) + np.sin(5 * t)
    w = np.zeros(N)
    for i in range(1, N):
        w[i] = w[i - 1] + (1 - np.exp(-1 / RATE / 0.3)) * (2 * u[i - 1] - w[i - 1])
    return np.column_stack([w + 0.005 * np.random.default_rng(seed).normal(size=N), u])


@pytest.mark.parametrize("mark", [",", ";", "\t", " ", "   "])
def test_a_bare_table_is_read_by_its_layout(tmp_path: Path, mark: str) -> None:
    path, head = tmp_path / "run.txt", "" if mark.strip() else "made by hand"
    np.savetxt(path, rows(), delimiter=mark, header=head)
    found = read_signals(path, {"w": SignalSpec("/csv.w"), "u": SignalSpec("/csv.u_cmd")}, LAYOUT)
    for k, name in enumerate("wu"):
        np.testing.assert_allclose(found[name].values, rows()[:, k])
        np.testing.assert_allclose(found[name].t, np.arange(N) * 1e9 / RATE, atol=1)


def test_arrays_without_times_have_those_of_the_rate(tmp_path: Path) -> None:
    from scipy.io import savemat

    w, u = rows().T
    savemat(tmp_path / "run.mat", {"w": w, "u_cmd": u, "fs": RATE})
    np.savez(tmp_path / "run.npz", w=w, u_cmd=u)
    for path, name in (("run.mat", "/mat.w"), ("run.npz", "/npz.w")):
        with pytest.raises(GroundedError, match=holding("rate")):
            inspect_log(tmp_path / path)
        found = read_signals(tmp_path / path, {"w": SignalSpec(name)}, Layout(rate=RATE))["w"]
        np.testing.assert_allclose(found.values, w)
        np.testing.assert_allclose(np.diff(found.t), 1e9 / RATE, atol=1)


def test_another_number_of_columns_is_refused(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "run.csv", rows(), delimiter=",")
    for columns in (("w",), ("w", "u", "v")):
        with pytest.raises(GroundedError, match=holding(2, len(columns))):
            inspect_log(tmp_path / "run.csv", Layout(columns, RATE))
    with pytest.raises(GroundedError, match=holding("--columns")):
        inspect_log(tmp_path / "run.csv")


def test_a_rate_takes_the_place_of_times(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("t,x\n" + "".join(f"0,{i}\n" for i in range(20)))
    report = inspect_log(path, Layout(rate=10.0))
    assert report.duration_s == pytest.approx(1.9)
    assert {field.path for field in report.numbers} == {"/csv.t", "/csv.x"}


@pytest.mark.slow
def test_three_commands_lead_to_a_diagnosis(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The layout is given to `init` alone; a folder of runs is given as one run is."""
    monkeypatch.chdir(tmp_path)
    Path("runs").mkdir()
    for k in range(2):
        np.savetxt(f"runs/run{k}.csv", rows(k))
    given = ("--columns", "w,u_cmd", "--rate", "50", "--yes")
    assert grounded("init", "motor", "--from", "runs", *given).code == 0
    assert grounded("-C", "motor", "ingest", "--data", "runs").code == 0
    assert len(Workspace("motor").trials()) == 2
    assert {"tau_w", "gain_w_u_cmd"} <= {*Workspace("motor").diagnose().verdict.parameters}
    assert grounded("-C", "motor", "inspect", "runs/run1.csv").code == 0


@pytest.mark.parametrize("kind", ["csv", "parquet", "mat"])
def test_columns_are_assigned_by_their_names_in_every_table(tmp_path: Path, kind: str) -> None:
    t = np.arange(N) / RATE
    names = ("pos_x", "pos_y", "heading_est", "ground_speed", "steering_cmd", "throttle_cmd")
    columns = {"t": t} | {name: np.sin((k + 1) * t / 7) for k, name in enumerate(names)}
    path = tmp_path / f"drive.{kind}"
    if kind == "csv":
        np.savetxt(
            path,
            np.column_stack([*columns.values()]),
            "%.6f",
            ",",
            header=",".join(columns),
            comments="",
        )
    elif kind == "mat":
        pytest.importorskip("scipy.io").savemat(path, columns)
    else:
        arrow = pytest.importorskip("pyarrow", reason="needs the extra parquet")
        pytest.importorskip("pyarrow.parquet").write_table(arrow.table(columns), path)
    assert grounded("init", str(tmp_path / "robot"), "--from", str(path), "--yes").code == 0
    log = tomllib.loads((tmp_path / "robot" / "grounded.toml").read_text())["log"]
    assert log["state"]["psi"]["path"].endswith("heading_est")
    assert log["input"]["steering"]["path"].endswith("steering_cmd")
