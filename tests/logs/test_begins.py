"""Logs that begin with a step: what was sent before their first row."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cli import grounded
from facts import of_code
from grounded.errors import GroundedError
from grounded_trials import Workspace

MODEL = """from grounded import Model, Param

model = Model(
    states={"T": "degC"},
    inputs={"Q1": "1"},
    params={"gain": Param(0.6, "degC", 0.1, 2.0), "tau": Param(150.0, "s", 20.0, 500.0)},
    derivative=lambda s, a, p: {"T": (23.0 + p.gain * a.Q1 - s.T) / p.tau},
)
"""


@pytest.fixture
def heater(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    """A heater at 50 % from its log's first row on, later at 20 %."""
    monkeypatch.chdir(tmp_path)
    t = np.arange(300.0)
    Q1, T = np.where(t < 200, 50.0, 20.0), np.full(300, 23.0)
    for i in range(1, 300):
        T[i] = T[i - 1] + (23 + 0.6 * Q1[i - 1] - T[i - 1]) / 150
    rows = np.column_stack([t, T, Q1])
    np.savetxt("heat.csv", rows, delimiter=",", header="t,T,Q1", comments="")
    Path("heater.py").write_text(MODEL)
    done = grounded("init", "w", "--from", "heat.csv", "--model", "heater.py", "--yes")
    assert done.code == 0, done.err
    return Workspace("w")


def test_what_was_sent_before_is_given(heater: Workspace) -> None:
    done = heater.ingest("heat.csv", data=True, before={"Q1": 0.0})
    assert not of_code(done, "log.from")
    (stored,) = heater.trials()
    trial = stored.trial
    assert trial.start_inputs.tolist() == [0.0]
    assert trial.inputs[0] in (0.0, 50.0) and trial.states[0] == pytest.approx(23.0, abs=0.2)
    assert 299 <= trial.steps <= 301
    with pytest.raises(GroundedError, match="Q1"):
        heater.ingest("heat.csv", data=True, before={"Q2": 0.0})
