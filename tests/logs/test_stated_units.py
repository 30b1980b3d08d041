"""A log that says mm beside a model in metres was taken in as metres, a thousand times too far."""

import numpy as np
import pytest

from cli import grounded
from facts import holds, of_code
from grounded.units import factor_between
from grounded_trials import Workspace
from grounded_trials.logs.stated_units import (
    unit_in_name,
    without_unit,
)

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
