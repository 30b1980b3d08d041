"""A slow process: two tanks, a row every 4 s, the upper level not measured.

Found on the measured benchmark of Wigren and Schoukens ("Coupled/cascaded tanks"), which is not
part of the project: the estimate was 0 throughout, and the fit did not move.
"""

import numpy as np
import pytest

from grounded_trials import Workspace
from grounded_trials.starting.begin import begin

DT, ROWS = 4.0, 400
NOMINAL = {"k1": 0.05, "k2": 0.05, "k3": 0.05, "k4": 0.05}
TRUE = {"k1": 0.04, "k2": 0.06, "k3": 0.055, "k4": 0.04}
MODEL = """
import numpy as np
from grounded import Model, Param

def dynamics(s, a, p):
    upper, lower = (np.sqrt(np.maximum(level, 1e-3)) for level in (s.upper, s.lower))
    return {"upper": p.k4 * a.pump - p.k1 * upper, "lower": p.k2 * upper - p.k3 * lower}

k = {name: Param(value, "1/s", 0.01, 0.2) for name, value in %r.items()}
model = Model(states={"upper": "V", "lower": "V"}, inputs={"pump": "V"}, params=k,
              derivative=dynamics)
"""


def flow(upper, lower, pump, p):
    out = np.sqrt(np.maximum([upper, lower], 1e-3))
    return p["k4"] * pump - p["k1"] * out[0], p["k2"] * out[0] - p["k3"] * out[1]


def measured(rng):
    """Return pump voltages, and both levels over time."""
    pump = np.repeat(rng.uniform(1.0, 4.0, ROWS // 20), 20)
    levels = np.empty((ROWS, 2))
    levels[0] = 5.0, 4.0
    for k in range(ROWS - 1):
        x = levels[k].copy()
        for _ in range(8):
            x = x + DT / 8 * np.array(flow(*x, pump[k], TRUE))
        levels[k + 1] = x
    return pump, levels


@pytest.fixture(scope="module")
def tanks(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("tanks"), np.random.default_rng(4)
    pump, levels = measured(rng)
    seen = levels[:, 1] + 0.01 * rng.standard_normal(ROWS)
    log = folder / "log.csv"
    table = np.column_stack([DT * np.arange(ROWS), pump, seen])
    np.savetxt(log, table, "%.6f", ",", header="time_s,pump,lower", comments="")
    (folder / "model.py").write_text(MODEL % NOMINAL)
    begun = begin(folder / "w", log, model=folder / "model.py")
    toml = folder / "w" / "grounded.toml"
    assert "[estimate]" in toml.read_text()  # nothing measures the upper level
    workspace = Workspace(folder / "w")
    workspace.ingest(log, data=True)
    return begun, workspace, levels


def test_a_fit_moves_though_the_hidden_state_bends_the_gradient(tanks):
    _, workspace, _ = tanks
    found = workspace.fit().fit
    assert found.status.startswith("converged")
    value = {name: e.value for name, e in found.params.items()}
    # the scale of the hidden level is free: what it does to the measured one is not
    assert value["k3"] == pytest.approx(TRUE["k3"], rel=0.05)
    assert value["k4"] * value["k2"] / value["k1"] == pytest.approx(
        TRUE["k4"] * TRUE["k2"] / TRUE["k1"], rel=0.05
    )
    assert all(e.low < TRUE[name] < e.high for name, e in found.params.items())
    assert found.prediction_error[-1].horizon_s == 10 * DT
