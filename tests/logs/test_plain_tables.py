"""Tables without names or times, in other units, or with times in ms: told, and kept in [log]."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from cli import grounded
from facts import holding, holds, of_code
from grounded.errors import GroundedError
from grounded.units import factor_between
from grounded_trials import Workspace
from grounded_trials.formats.tables import Layout
from grounded_trials.logs.inspection.inspect_log import inspect_log
from grounded_trials.logs.signals import SignalSpec, read_signals
from grounded_trials.logs.stated_units import unit_in_name, without_unit
from grounded_trials.starting.begin import begin

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


MODEL = """from grounded import Model, Param
model = Model(states={"x": "m", "v": "m/s", "theta": "rad"}, inputs={"volt": "V"},
    params={"k": Param(1.0, "1/s", 0.5, 2.0)},
    derivative=lambda s, a, p: {"x": s.v, "v": a.volt - p.k * s.v, "theta": a.volt - s.theta})
"""


@pytest.mark.parametrize(
    ("said", "wanted", "factor"),
    [
        ("mm", "m", 1e-3),
        ("mm/s^2", "m/s^2", 1e-3),
        ("deg/s", "rad/s", np.pi / 180),
        ("rpm", "rad/s", np.pi / 30),
        ("km/h", "m/s", 1 / 3.6),
        ("mN m", "N m", 1e-3),
        ("N·m", "N m", 1.0),
        ("%", "1", 0.01),
        ("m", "rad", None),
        ("furlong", "m", None),
        ("km^400", "m", None),  # no power overflows
        ("m^99999999999999999999", "m", None),
    ],
)
def test_the_factor_between_two_units(said, wanted, factor):
    assert factor_between(said, wanted) == (factor and pytest.approx(factor))


def signals_of(tmp_path, model: str) -> dict:
    """The signals that `init` finds for a model in log.csv."""
    (tmp_path / "m.py").write_text(model)
    log, file = tmp_path / "log.csv", tmp_path / "m.py"
    made = grounded("init", tmp_path / "w", "--from", log, "--model", file, "--yes", "--json")
    assert made.code == 0, made.err
    return {one["name"]: one for one in made.json["signals"]}


def test_units_in_a_table_s_first_row_become_scales(tmp_path):
    t = np.arange(0, 4, 0.02)
    v = np.sin(t)
    x, theta = np.cumsum(v) * 0.02, 0.3 * np.cos(t)
    rows = np.column_stack([t, 1e3 * x, 1e3 * v, np.rad2deg(theta), np.cos(t) + v])
    head = "t,x [mm],v [mm/s],theta (deg),volt [V]"
    np.savetxt(tmp_path / "log.csv", rows, "%.6f", ",", header=head, comments="")
    w = tmp_path / "w"
    signals_of(tmp_path, MODEL)
    whole = (w / "grounded.toml").read_text()
    (w / "grounded.toml").write_text(whole.replace("scale = 0.001\n", "", 1))
    bare = grounded("-C", w, "ingest", "--data", tmp_path / "log.csv", "--json")
    assert holds(bare.json["trials"][0]["warnings"][0], "x", "mm", "0.001")
    grounded("-C", w, "discard", "t0001")
    (w / "grounded.toml").write_text(whole)
    done = grounded("-C", w, "ingest", "--data", tmp_path / "log.csv", "--json")
    assert not done.json["trials"][0]["warnings"]
    assert done.code == 0, done.err
    high = {signal["name"]: signal["high"] for signal in done.json["trials"][0]["signals"]}
    assert high["x"] == pytest.approx(x.max(), rel=0.01)
    assert high["v"] == pytest.approx(1.0, rel=0.01)
    assert high["theta"] == pytest.approx(0.3, rel=0.01)
    assert high["volt"] == pytest.approx(np.sqrt(2), rel=0.02)


@pytest.mark.parametrize(
    ("path", "unit", "bare"),
    [
        ("/csv.r_mm", "mm", "/csv.r"),
        ("/csv.thd_deg_s", "deg/s", "/csv.thd"),
        ("/csv.v_m_s", "m/s", "/csv.v"),
        ("/imu.yaw_deg", "deg", "/imu.yaw"),
        ("/arm.q_deg[2]", "deg", "/arm.q"),
        ("/speed_mps.data", "m/s", "/speed"),
        ("/csv.vel_N", "N", "/csv.vel_N"),
        ("/csv._mm", "", "/csv._mm"),
        ("/csv.summ", "", "/csv.summ"),
        ("/mcu.steering_pct", "%", "/mcu.steering"),
        ("/mcu.steering_percent", "%", "/mcu.steering"),
        ("/imu.orientation.@rpy.yaw", "", "/imu.orientation.@rpy.yaw"),
    ],
)
def test_the_end_of_a_name_says_a_unit(path, unit, bare):
    assert unit_in_name(path) == unit
    assert without_unit(path) == bare


BEAM = """from grounded import Model, Param
model = Model(states={"r": "m", "rd": "m/s", "th": "rad", "thd": "rad/s"}, inputs={"volt": "V"},
    params={"k": Param(1.0, "1/s", 0.5, 2.0)},
    derivative=lambda s, a, p: {"r": s.rd, "rd": -7 * s.th, "th": s.thd, "thd": a.volt - s.thd})
"""


MM, DEG = 1e-3, np.pi / 180


def begun(tmp_path, head: str, factors: dict[str, float]) -> dict:
    """The signals that `init` finds in a log of the beam, each divided by its factor."""
    t = np.arange(0, 8, 0.02)
    th, thd = 0.1 * np.sin(2 * t), 0.2 * np.cos(2 * t)
    rd, r = 0.35 * (np.cos(2 * t) - 1), 0.35 * (np.sin(2 * t) / 2 - t)
    signals = {"r": r, "rd": rd, "th": th, "thd": thd, "volt": thd - 0.4 * np.sin(2 * t)}
    rows = np.column_stack([t, *(x / factors.get(name, 1) for name, x in signals.items())])
    np.savetxt(tmp_path / "log.csv", rows, "%.6f", ",", header=head, comments="")
    return signals_of(tmp_path, BEAM)


@pytest.mark.parametrize(
    "head",
    [
        "t,r_mm,rd,th_deg,thd_deg,volt",
        "t,r [mm],rd [m/s],th [deg],thd,volt",
    ],
)
def test_names_and_heads_make_scales_and_a_rate_is_compared_after_them(tmp_path, head):
    factors = {"r": MM, "th": DEG, "thd": DEG}
    found = begun(tmp_path, head, factors)
    assert {n: one["scale"] for n, one in found.items()} == {
        n: pytest.approx(factors.get(n, 1.0)) for n in found
    }
    assert all(one["sure"] for one in found.values())


TURNED = """import numpy as np

from grounded import Model, Param

model = Model(
    states={"yaw": "rad", "v": "m/s"},
    inputs={"speed": "m/s", "steering": "rad"},
    params={"L": Param(0.35, "m", 0.1, 1.0), "tau": Param(0.3, "s", 0.05, 1.0)},
    derivative=lambda s, a, p: {
        "yaw": s.v * np.tan(a.steering) / p.L,
        "v": (a.speed - s.v) / p.tau,
    },
    angles=("yaw",),
)
"""


def test_a_heading_in_wrapped_degrees_is_told_when_it_comes_in(tmp_path):
    rng, dt, t = np.random.default_rng(0), 0.05, 0.05 * np.arange(600)
    speed = 0.5 + 0.5 * np.repeat(rng.uniform(0, 1, 30), 20)
    steering, rows, yaw, v = 0.3 * np.sin(0.4 * t) + 0.24, [], 0.0, 0.0
    for k in range(600):
        wrapped = (np.degrees(yaw) + rng.normal(0, 0.6) + 180) % 360 - 180
        rows.append([t[k], wrapped, v + rng.normal(0, 0.01), speed[k], steering[k]])
        yaw += dt * v * np.tan(steering[k]) / 0.3
        v += dt * (speed[k] - v) / 0.25
    head = "t,yaw,v,speed_cmd,steering_cmd"
    np.savetxt(tmp_path / "run.csv", rows, "%.6g", ",", header=head, comments="")
    (tmp_path / "m.py").write_text(TURNED)
    w = Workspace.create(tmp_path / "w", log=tmp_path / "run.csv", model=tmp_path / "m.py")
    (told,) = of_code(w.ingest(tmp_path / "run.csv", data=True), "log.unit")
    assert told.about == ("yaw",)


def in_ms(path, column="t", seconds=1e-3):
    """20 s of a cart at 100 Hz, whose first row is at 0; times in units of `seconds`."""
    t = np.arange(2000) * 0.01
    u = np.where((t % 2) < 1, 1.0, -1.0)
    rows = np.column_stack([t / seconds, np.cumsum(u) * 0.01, u])
    np.savetxt(path, rows, "%.6g", ",", header=f"{column},v,force", comments="")
    return path


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
    assert done.out.replace("\\", "").split()[-2:] == ["fit", "--apply"]  # over two lines, too
