"""Columns that no name gives, but the unit, the derivative and the lack of any other pair do."""

import numpy as np
import pytest

from grounded_trials.starting.begin import begin

MODEL = """from grounded import Model

model = Model(
    states={"x": "m", "v": "m/s", "th": "rad", "w": "rad/s"},
    inputs={"volts": "V"},
    derivative=lambda s, a, p: {"x": s.v, "v": a.volts - s.v, "th": s.w, "w": -s.th - s.v},
)
"""


def found_in(folder, **renamed):
    """The guesses for a cart-pole's table, some columns of it under other names, or beside."""
    t = np.arange(0, 30, 0.02)
    phase = 1.3 * t + 0.02 * t**2
    x, v = 0.2 * np.sin(phase), 0.2 * (1.3 + 0.04 * t) * np.cos(phase)
    th, w = 40 * np.sin(5.1 * t), 40 * 5.1 * np.cos(5.1 * t)
    columns = {
        "cart_mm": 1e3 * x,
        "cart_speed": 1e3 * v,
        "pole_deg": th,
        "pole_speed": w,
        "volts": np.round(4 * np.sin(3 * t + np.sin(0.4 * t)), 1),
    }
    columns = {renamed.get(name, name): values for name, values in columns.items()}
    columns |= {"belt_mm": 1e3 * x + 5 * np.sin(9 * t)} if "belt" in renamed else {}
    rows = np.column_stack([1e3 * t, *columns.values()])
    head = ",".join(("time_ms", *columns))
    np.savetxt(folder / "hand.csv", rows, "%.6f", ",", header=head, comments="")
    (folder / "m.py").write_text(MODEL)
    done = begin(folder / "w", folder / "hand.csv", model=folder / "m.py")
    return {g.name: g for g in done.states}


def test_what_unit_derivative_and_the_only_pair_agree_on_is_sure(tmp_path):
    by = found_in(tmp_path)
    assert {name: g.path for name, g in by.items()} == {
        "x": "/csv.cart_mm",
        "v": "/csv.cart_speed",
        "th": "/csv.pole_deg",
        "w": "/csv.pole_speed",
    }
    assert all(g.sure and not g.others for g in by.values())
    assert by["x"].scale == by["v"].scale == 1e-3
    assert by["th"].scale == by["w"].scale == pytest.approx(np.pi / 180)


def test_without_a_unit_it_is_asked(tmp_path):
    by = found_in(tmp_path, pole_deg="pole")
    assert not by["th"].sure and by["x"].sure


@pytest.mark.parametrize("sign", [1, -1])
def test_a_rate_of_the_opposite_sign_is_asked(tmp_path, sign):
    """Of a slow swing, an exchange fits as well: either is possible."""
    t = np.arange(0, 30, 0.02)
    rows = np.column_stack([t, np.sin(t), sign * np.cos(t), np.round(np.sin(3 * t), 1)])
    np.savetxt(tmp_path / "a.csv", rows, "%.6f", ",", header="t,th,w,volts", comments="")
    text = MODEL.replace('"x": "m", "v": "m/s", ', "").replace('"x": s.v, "v": a.volts - s.v, ', "")
    (tmp_path / "m.py").write_text(text.replace("- s.v}", "+ a.volts}"))
    done = begin(tmp_path / "w", tmp_path / "a.csv", model=tmp_path / "m.py")
    _, w = done.states
    assert w.sure == (sign > 0) and w.scale == sign
