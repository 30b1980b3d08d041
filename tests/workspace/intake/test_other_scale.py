"""A measured column times a constant: it was told that somebody took over."""

from dataclasses import replace

import numpy as np
import pytest

from facts import holds, of_code
from grounded.errors import GroundedError
from grounded.result import listed
from grounded_trials import Workspace
from grounded_trials.store.trial_file import read_trial, write_trial
from recorded import LOGGED, record
from workspaces import MODEL, make

ROVER = """import numpy as np

from grounded import Model, Param

model = Model(
    states={"x": "m", "y": "m", "psi": "rad", "u": "m/s", "r": "rad/s"},
    inputs={"drive": "V", "turn": "V"},
    params={"drag": Param(4.0, "N s/m", 1.0, 12.0)},
    angles=("psi",),
    derivative=lambda s, a, p: {
        "x": s.u * np.cos(s.psi),
        "y": s.u * np.sin(s.psi),
        "psi": s.r,
        "u": (a.drive - p.drag * s.u) / 6,
        "r": (1.5 * a.turn - s.r) / 0.4,
    },
)
"""
CONFIG = """[model]
file = "model.py"
[task]
dt = 0.05
horizon = 120
target = "target.csv"
start = { u = 1.0 }
[reward]
state = { x = 4.0, y = 4.0, psi = 0.5, u = 0.5 }
input_change = { drive = 0.01, turn = 0.01 }
[limits]
drive = [-10.0, 15.0]
turn = [-2.0, 2.0]
[system]
model = "model.py"
noise.measurement = { x = 0.01, y = 0.01, psi = 0.004, u = 0.01, r = 0.01 }
"""


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """A rover's workspace, and a run of its first candidate."""
    t = np.arange(121) * 0.05
    rows = np.column_stack([t, 3 * np.sin(t / 3), 3 - 3 * np.cos(t / 3), t / 3, 1 + 0 * t])
    text = "\n".join(",".join(f"{v:.6f}" for v in row) for row in rows)
    folder = tmp_path_factory.mktemp("w") / "w"
    made = make(folder, config=CONFIG, model=ROVER, target=f"t,x,y,psi,u\n{text}\n")
    w = Workspace(made.folder)
    w.propose()
    w.run()
    return w, *read_trial(next((w.folder / "runs").iterdir()))[:2]


@pytest.mark.slow
@pytest.mark.parametrize(
    "names, factor",
    [
        ("psi r", -1.0),  # an IMU that is mounted upside down
        ("drive turn", 1e3),  # in mV, both
    ],
)
def test_the_columns_and_their_factor_are_named(driven, tmp_path, names, factor):
    w, trial, meta = driven
    by, sent = (
        [factor if name in names.split() else 1.0 for name in every]
        for every in (trial.state_names, trial.input_names)
    )
    odd = replace(trial, states=trial.states * by, inputs=trial.inputs * sent)
    write_trial(tmp_path / "odd.mcap", odd, {k: meta[k] for k in ("kind", "task")})
    with pytest.raises(GroundedError) as refused:
        w.ingest(tmp_path / "odd.mcap")
    told = refused.value.finding
    assert holds(str(refused.value), listed(names.split()))
    assert any(told.facts.get(k) == pytest.approx(1 / factor, rel=5e-3) for k in ("by", "times"))
    named = w.ingest(tmp_path / "odd.mcap", candidate=trial.candidate)
    assert of_code(named, told.code)


def test_a_rate_that_is_logged_in_radians_for_a_model_in_degrees_is_told(tmp_path, before=0.7):
    model = MODEL.replace('"force": "N"', '"force": "deg/s"')
    w = Workspace(make(tmp_path / "w", config=LOGGED, model=model).folder)
    log = record(w, tmp_path / "a.csv", w.propose().candidate.policy, before)
    rows = np.loadtxt(log, delimiter=",", skiprows=1)
    rows[:, 3] = np.deg2rad(rows[:, 3])
    np.savetxt(log, rows, "%.6f", ",", header="t,x,v,force", comments="")
    with pytest.raises(GroundedError) as refused:
        w.ingest(log)
    assert holds(str(refused.value), "c0001", "force", "57.29578", "in rad/s")
