"""What a boat's log calls things: north and east, surge and sway, a heading in degrees."""

from pathlib import Path

import numpy as np
import pytest

from grounded_trials.starting.begin import begin

MODEL = """import numpy as np
from grounded import Model

model = Model(
    states={"x": "m", "y": "m", "psi": "rad", "u": "m/s", "v": "m/s", "r": "rad/s"},
    inputs={"thrust": "N", "rudder": "rad"},
    angles=("psi",),
    derivative=lambda s, a, p: {
        "x": s.u * np.cos(s.psi) - s.v * np.sin(s.psi),
        "y": s.u * np.sin(s.psi) + s.v * np.cos(s.psi),
        "psi": s.r,
        "u": a.thrust - s.u,
        "v": -s.v,
        "r": a.rudder - s.r,
    },
)
"""


def found_in(folder: Path, names: dict[str, str]) -> dict[str, tuple[str, bool, float, set[str]]]:
    """The guesses for a table with these columns in the place of a boat's."""
    t = np.arange(0, 30, 0.1)
    psi, u = 0.8 * np.sin(0.5 * t), 1 + 0.2 * np.sin(0.3 * t)
    r, v = 0.4 * np.cos(0.5 * t), 0.05 * np.cos(0.4 * t)
    x, y = np.cumsum(u * np.cos(psi)) * 0.1, np.cumsum(u * np.sin(psi)) * 0.1
    thrust, rudder = np.round(5 + 2 * np.sin(t), 1), np.round(0.3 * np.cos(t / 2), 2)
    own = {
        "north": x,
        "east": y,
        "heading": np.rad2deg(psi),
        "surge": u,
        "sway": v,
        "yaw_rate": np.rad2deg(r),
    }
    columns = {"t": t} | {names[n]: y for n, y in own.items() if n in names}
    columns |= {"thrust_cmd_N": thrust, "rudder_cmd_rad": rudder}
    rows = np.column_stack(list(columns.values()))
    path = folder / "boat.csv"
    np.savetxt(path, rows, "%.6f", ",", header=",".join(columns), comments="")
    (folder / "m.py").write_text(MODEL)
    done = begin(folder / "w", path, model=folder / "m.py")
    return {
        g.name: (g.path.removeprefix("/csv."), g.sure, g.scale, {*g.others}) for g in done.states
    }


def test_a_boats_columns_are_found(tmp_path: Path) -> None:
    named = {"north": "north_m", "east": "east_m", "heading": "heading_deg"}
    named |= {"surge": "surge_m_s", "sway": "sway_m_s", "yaw_rate": "yaw_rate_deg_s"}
    found = found_in(tmp_path, named)
    degree = pytest.approx(np.pi / 180)
    assert found["x"] == ("north_m", False, 1.0, {"/csv.east_m"})  # x may as well be east
    assert found["y"] == ("east_m", False, 1.0, {"/csv.north_m"})
    assert found["psi"] == ("heading_deg", True, degree, set())
    assert found["u"] == ("surge_m_s", True, 1.0, set())
    assert found["v"] == ("sway_m_s", True, 1.0, set())
    assert found["r"] == ("yaw_rate_deg_s", True, degree, set())


def test_one_axis_of_the_compass_alone_is_no_place(tmp_path: Path) -> None:
    named = {"north": "north_m", "heading": "heading_deg", "yaw_rate": "yaw_rate_deg_s"}
    found = found_in(tmp_path, named)
    assert found["x"][0] == found["y"][0] == ""
