"""Logs of a wheeled robot whose positions are both in another unit: by hand, of a candidate."""

import numpy as np
import pytest

from facts import holds, of_code
from grounded.errors import GroundedError
from grounded_trials import Workspace
from grounded_trials.store.trial_file import read_trial
from workspaces import make

MODEL = """import numpy as np
from grounded import Model, Param
model = Model(
    states={"x": "m", "y": "m", "psi": "rad"},
    inputs={"left": "rad/s", "right": "rad/s"},
    params={"r": Param(0.05, "m", 0.045, 0.055), "track": Param(0.28, "m", 0.24, 0.36)},
    angles=("psi",),
    derivative=lambda s, a, p: {
        "x": p.r * (a.left + a.right) / 2 * np.cos(s.psi),
        "y": p.r * (a.left + a.right) / 2 * np.sin(s.psi),
        "psi": p.r * (a.right - a.left) / p.track,
    },
)
"""
CONFIG = """[model]
file = "model.py"
[task]
dt = 0.05
horizon = 100
target = "target.csv"
[reward]
state = { x = 1.0, y = 1.0, psi = 0.1 }
input_change = { left = 0.0001, right = 0.0001 }
[limits]
left = [-14.0, 14.0]
right = [-14.0, 14.0]
[system]
model = "model.py"
[log]
state = { x = { path = "/csv.x" }, y = { path = "/csv.y" }, psi = { path = "/csv.psi" } }
input = { left = { path = "/csv.left" }, right = { path = "/csv.right" } }
"""
HEAD = "t,x,y,psi,left,right"
T = np.arange(101) * 0.05
ARC = np.column_stack([T, 0.8 * np.sin(T / 2), 0.8 * (1 - np.cos(T / 2)), T / 2])
TARGET = "t,x,y,psi\n" + "\n".join(",".join(f"{v:.4f}" for v in row) for row in ARC) + "\n"


@pytest.fixture
def w(tmp_path):
    return Workspace(make(tmp_path / "w", config=CONFIG, model=MODEL, target=TARGET).folder)


def by_hand(w, path, scale):
    """300 steps of a robot with a weak left wheel, as a table; positions times `scale`."""
    model, rng = w.base_model, np.random.default_rng(0)
    x, rows = np.zeros(3), []
    for k, u in enumerate(np.repeat(rng.uniform(-2, 10, (30, 2)), 10, axis=0)):
        seen = (x + rng.normal(0, 1e-3, 3)) * [scale, scale, 1.0]
        rows.append([0.05 * k, *seen, *u])
        x = model.system.step(x[None], u[None] * [0.88, 1.0], model.values, 0.05)[0]
    np.savetxt(path, rows, "%.8f", ",", header=HEAD, comments="")
    return path


def run_of(w, path, scale):
    """The waiting candidate's run as a table, positions times `scale`."""
    w.run()
    trial = read_trial(next((w.folder / "runs").iterdir()))[0]
    t = trial.dt * np.arange(trial.steps)
    table = np.column_stack([t, trial.states[:-1] * [scale, scale, 1.0], trial.inputs])
    np.savetxt(path, table, "%.9f", ",", header=HEAD, comments="")
    return path


def test_a_log_whose_positions_are_a_thousand_times_too_small_is_told(w, tmp_path):
    found = w.ingest(by_hand(w, tmp_path / "km.csv", 1e-3), data=True)
    assert len(found.faults) == 1 and found.then.verb == "discard"
    (told,) = of_code(found, "log.unit")
    assert (told.about, told.facts["by"]) == (("x", "y"), pytest.approx(1000))
    with pytest.raises(GroundedError, match=r"x and y.*1000"):
        w.preflight()


def test_a_sound_log_is_not(w, tmp_path):
    assert not w.ingest(by_hand(w, tmp_path / "m.csv", 1.0), data=True).warnings


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_a_run_whose_positions_are_in_another_unit_is_its_candidate_s(w, tmp_path, scale):
    plan = w.propose().candidate
    with pytest.raises(GroundedError) as refused:
        w.ingest(run_of(w, tmp_path / "run.csv", scale))
    said = str(refused.value)
    assert holds(said, plan.id, "x and y", "[log.state.x]", f"by {1 / scale:.6g}")
