"""A log that says mm beside a model in metres was taken in as metres, a thousand times too far."""

import numpy as np
import pytest

from cli import grounded
from facts import holds
from grounded_trials.logs.stated_units import factor_between

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
    ],
)
def test_the_factor_between_two_units(said, wanted, factor):
    assert factor_between(said, wanted) == (factor and pytest.approx(factor))


def test_units_in_a_table_s_first_row_become_scales(tmp_path):
    t = np.arange(0, 4, 0.02)
    v = np.sin(t)
    x, theta = np.cumsum(v) * 0.02, 0.3 * np.cos(t)
    rows = np.column_stack([t, 1e3 * x, 1e3 * v, np.rad2deg(theta), np.cos(t) + v])
    head = "t,x [mm],v [mm/s],theta (deg),volt [V]"
    np.savetxt(tmp_path / "log.csv", rows, "%.6f", ",", header=head, comments="")
    (tmp_path / "m.py").write_text(MODEL)
    w = tmp_path / "w"
    made = grounded(
        "init", w, "--from", tmp_path / "log.csv", "--model", tmp_path / "m.py", "--yes"
    )
    assert made.code == 0, made.err
    whole = (w / "grounded.toml").read_text()
    (w / "grounded.toml").write_text(whole.replace("scale = 0.001\n", "", 1))
    bare = grounded("-C", w, "ingest", "--data", tmp_path / "log.csv", "--json")
    assert holds(bare.json["trials"][0]["warnings"][0], "x", "mm", "scale = 0.001")
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
