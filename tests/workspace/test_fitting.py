"""`fit` in a workspace: the sensors first, nothing written that predicts worse, no round trips."""

from pathlib import Path

import numpy as np
import pytest

from cli import grounded
from grounded.effects.sensor import lagging
from grounded.errors import GroundedError, NextCommand
from grounded.rollout import simulate
from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.store.trial_file import write_trial
from workspaces import make

DT = 0.05


def noisy(states: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return states + rng.normal(0, 0.002, states.shape)


def filtered(states: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The speed is shown by a sensor that filters it over 0.1 s."""
    off, v, seen = 0.0, states[:, 1], states.copy()
    for t in range(1, len(v)):
        off = lagging(off, v[t] - v[t - 1], 0.1, DT)
        seen[t, 1] += off
    return noisy(seen, rng)


def logs(
    folder: Path, masses: list[float], shown=noisy, steps: int = 40, alike: int = 1
) -> Workspace:
    """A workspace of a cart driven with these masses [kg], the first few by the same commands."""
    w, rng = Workspace(make(folder).folder), np.random.default_rng(0)
    names = (w.base_model.state_names, w.base_model.input_names)
    for k, mass in enumerate(masses):
        robot = w.task.with_model(w.base_model.with_values({"mass": mass}))
        if not 0 < k < alike:
            force = np.repeat(rng.uniform(-4, 4, (steps // 8, 1)), 8, axis=0)
        run = simulate(robot.problem(exact=True), robot.policy(force, None, None))
        seen = shown(run.states, rng)
        write_trial(folder / f"{k}.mcap", Trial(seen, force, DT, *names), {"kind": "data"})
        w.ingest(folder / f"{k}.mcap", data=True)
    return w


@pytest.fixture
def misled(tmp_path: Path) -> Workspace:
    """One motion alone was driven with another mass, three times: no other trial confirms it."""
    return logs(tmp_path / "w", [1.4] * 3 + [1.0] * 7, alike=3)


def test_what_the_sensors_filter_is_corrected_before_parameters_are_fitted(tmp_path):
    w = logs(tmp_path / "w", [1.4] * 6, filtered)
    (seen,) = w.preflight()
    assert (seen.signal, seen.kind) == ("v", "lag")
    found = w.fit()
    assert [one.to_json() for one in found.preflight] == [seen.to_json()]
    assert found.fit.helps and found.then == NextCommand("fit", ("--apply",))
    w.fit(apply=True)
    assert w.base_model.params["mass"].value == pytest.approx(1.4, rel=0.02)


def test_values_that_predict_worse_are_never_written(misled):
    before = misled.config.file.read_text()
    found = misled.fit()
    assert not found.fit.helps and found.fit.params["mass"].value > 1.05
    assert found.then == NextCommand("diagnose")  # nobody has yet
    with pytest.raises(GroundedError) as refused:
        misled.fit(apply=True)
    assert refused.value.then == NextCommand("diagnose")
    done = grounded("-C", misled.folder, "fit", "--params", "mass", "--apply")
    assert done.code == 1 and "Traceback" not in done.err
    assert misled.config.file.read_text() == before
