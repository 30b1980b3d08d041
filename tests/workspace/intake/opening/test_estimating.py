"""Speeds that no sensor gives, along a whole log: gaps, slow sensors, units, the noise."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.errors import GroundedError
from grounded.model import Model
from grounded_trials import Workspace
from grounded_trials.logs.signals import Series, SignalSpec
from grounded_trials.workspace.intake.opening.estimating import EstimateTable, with_estimates
from grounded_trials.workspace.user_files.config import set_keys
from workspaces import CONFIG, make

TABLE = EstimateTable({"x": 0.002}, {})


def series(t, values, path="/csv.x"):
    stamps = np.round(1e9 * (1000 + t)).astype(np.int64)
    return Series(SignalSpec(path, "log"), stamps, values, stamps, len(t), "table")


def driven(every=0.01, until=6.0, size=1.0, noise=0.002, seed=0):
    """A cart heavier than the model's, pushed to and fro at 20 Hz: samples, and the true speed."""
    fine = 1e-3
    t = np.arange(0, until, fine)
    force = np.where(t < 1, 0.0, 2 * np.sin(2 * np.floor(t / 0.05) * 0.05))
    x = v = 0.0
    path = []
    for u in force:
        path.append((x, v))
        x, v = x + fine * v, v + fine * (u - 0.4 * v) / 1.3
    x, v = size * np.transpose(path)
    at = np.arange(0, len(t), round(every / fine))
    rng = np.random.default_rng(seed)
    found = {
        "x": series(t[at], x[at] + size * noise * rng.standard_normal(len(at))),
        "force": series(t[::10], force[::10], "/csv.force"),
    }
    return found, t, v


@pytest.fixture
def task(tmp_path):
    return make(tmp_path / "w").task


def off(found, t, v):
    """The error of the estimated speed, and when [s]."""
    at = (found["v"].t - 1000 * 10**9) * 1e-9
    inside = (at >= 0) & (at <= t[-1])
    return found["v"].values[inside] - np.interp(at[inside], t, v), at[inside]


def test_a_speed_is_estimated_in_steps_that_a_simulator_can_make(task):

    class Simulator:
        timestep = 0.025

        def __call__(self, s, a, p, dt):
            if abs(dt / self.timestep - round(dt / self.timestep)) > 1e-6:
                raise GroundedError(f"{dt:g} s is no multiple")
            return {"x": s.x + dt * s.v, "v": s.v + dt * (a.force - 0.4 * s.v) / 1.3}

    model = Model(states=task.model.states, inputs=task.model.inputs, step=Simulator())
    logged, t, v = driven(0.01)
    error, _ = off(with_estimates(logged, TABLE, replace(task, model=model)), t, v)
    assert np.sqrt(np.mean(error**2)) < 0.06


def test_nothing_is_estimated_where_everything_is_measured(task):
    logged, t, v = driven()
    logged["v"] = series(t[::10], v[::10], "/csv.v")
    table = EstimateTable({"x": 0.002, "v": 0.01}, {})
    assert with_estimates(logged, table, task) == logged


def disturbed(lag, friction, until=6.0, fine=1e-3):
    """The crude model's cart with a lag or a friction."""
    t = np.arange(0, until, fine)
    held = np.floor(t / 0.05) * 0.05
    force = np.where(t < 1, 0.0, 3 * np.sin(2 * held) + 1.5 * np.sign(np.sin(5 * held)))
    x = v = u = 0.0
    path = []
    for k in force:
        path.append((x, v))
        u += fine / max(lag, fine) * (k - u)
        x, v = x + fine * v, v + fine * (u - 0.2 * v - friction * np.tanh(v / 0.02))
    x, v = np.transpose(path)
    noisy = x[::10] + 0.002 * np.random.default_rng(0).standard_normal(len(x[::10]))
    return {"x": series(t[::10], noisy), "force": series(t[::10], force[::10], "/u")}, t, v


def test_trials_that_another_model_estimated_stay_and_are_told(tmp_path):
    lines = [f'[log.{k}.{n}]\npath = "/csv.{n}"' for k, n in (("state", "x"), ("input", "force"))]
    config = CONFIG + "\n".join([*lines, "[estimate]", "measured = { x = 0.002 }"])
    folder = make(tmp_path / "w", config=config).folder
    for k in range(1):
        logged, _, _ = disturbed(0.0, 0.8, until=4.0 + k)
        t = logged["x"].t * 1e-9 + 100 * k
        table = np.column_stack([t, logged["x"].values, logged["force"].values])
        np.savetxt(tmp_path / f"{k}.csv", table, "%.5f", ",", header="t,x,force", comments="")
    first = Workspace(folder).ingest(tmp_path / "0.csv", data=True)
    before = Workspace(folder).trials()[0].measured.states
    set_keys(folder / "grounded.toml", "model", effects=[{"name": "coulomb_friction:v", "c": 0.8}])
    w = Workspace(folder)
    again = w.ingest(tmp_path / "0.csv", data=True)
    assert again.known and again.trial == first.trial
    np.testing.assert_array_equal(w.trials()[0].measured.states, before)
    w.discard("t0001")
    anew = w.ingest(tmp_path / "0.csv", data=True)
    assert not anew.known and anew.trial != first.trial


def test_seconds_under_a_column_of_milliseconds_are_told(task):
    logged, _, _ = driven()
    log = {n: replace(one, t=one.t[0] + (one.t - one.t[0]) // 1000) for n, one in logged.items()}
    with pytest.raises(GroundedError, match="in another unit"):
        with_estimates(log, TABLE, task)
