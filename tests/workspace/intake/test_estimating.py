"""States that no sensor gives: along a whole log, of a slow process, of a robot at rest."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.errors import GroundedError
from grounded.model import Model
from grounded_trials import Workspace
from grounded_trials.formats.mcap_writer import McapWriter
from grounded_trials.formats.protobuf import encode_doubles
from grounded_trials.logs.signals import Series, SignalSpec
from grounded_trials.starting.begin import begin
from grounded_trials.workspace.intake.opening.estimating import EstimateTable, with_estimates
from grounded_trials.workspace.user_files.config import set_keys
from stepped import levels, stepped
from workspaces import CONFIG, make

TABLE = EstimateTable({"x": 0.002}, {})


def series(t, values, path="/csv.x"):
    stamps = np.round(1e9 * (1000 + t)).astype(np.int64)
    return Series(SignalSpec(path, "log"), stamps, values, stamps, len(t), "table")


def driven(until=6.0, fine=1e-3):
    """A cart heavier than the model's, pushed to and fro at 20 Hz: samples, and the true speed."""
    t = np.arange(0, until, fine)
    force = np.where(t < 1, 0.0, 2 * np.sin(2 * np.floor(t / 0.05) * 0.05))
    x, v = stepped(
        lambda x, u: np.array([x[1], (u[0] - 0.4 * x[1]) / 1.3]), force, fine, np.zeros(2), fine=1
    )[:-1].T
    noise = 0.002 * np.random.default_rng(0).standard_normal(len(t[::10]))
    found = {
        "x": series(t[::10], x[::10] + noise),
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
    logged, t, v = driven()
    error, _ = off(with_estimates(logged, TABLE, replace(task, model=model)), t, v)
    assert np.sqrt(np.mean(error**2)) < 0.06


def test_nothing_is_estimated_where_everything_is_measured(task):
    logged, t, v = driven()
    logged["v"] = series(t[::10], v[::10], "/csv.v")
    table = EstimateTable({"x": 0.002, "v": 0.01}, {})
    assert with_estimates(logged, table, task) == logged


def test_trials_that_another_model_estimated_stay_and_are_told(tmp_path):
    lines = [f'[log.{k}.{n}]\npath = "/csv.{n}"' for k, n in (("state", "x"), ("input", "force"))]
    config = CONFIG + "\n".join([*lines, "[estimate]", "measured = { x = 0.002 }"])
    folder = make(tmp_path / "w", config=config).folder
    logged, _, _ = driven()
    table = np.column_stack([logged["x"].t * 1e-9, logged["x"].values, logged["force"].values])
    np.savetxt(tmp_path / "0.csv", table, "%.5f", ",", header="t,x,force", comments="")
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


def flow(x, u, p=TRUE):
    out = np.sqrt(np.maximum(x, 1e-3))
    return np.array([p["k4"] * u[0] - p["k1"] * out[0], p["k2"] * out[0] - p["k3"] * out[1]])


@pytest.fixture(scope="module")
def tanks(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("tanks"), np.random.default_rng(4)
    pump = levels(rng, ROWS // 20, 20, 1.5)[:, 0] + 2.5
    path = stepped(flow, pump, DT, [5.0, 4.0], fine=8)[:-1]
    seen = path[:, 1] + 0.01 * rng.standard_normal(ROWS)
    log = folder / "log.csv"
    table = np.column_stack([DT * np.arange(ROWS), pump, seen])
    np.savetxt(log, table, "%.6f", ",", header="time_s,pump,lower", comments="")
    (folder / "model.py").write_text(MODEL % NOMINAL)
    begin(folder / "w", log, model=folder / "model.py")
    toml = folder / "w" / "grounded.toml"
    assert "[estimate]" in toml.read_text()  # nothing measures the upper level
    workspace = Workspace(folder / "w")
    workspace.ingest(log, data=True)
    return workspace


def test_a_fit_moves_though_the_hidden_state_bends_the_gradient(tanks):
    found = tanks.fit().fit
    assert found.status.startswith("converged")
    value = {name: e.value for name, e in found.params.items()}
    # the scale of the hidden level is free: what it does to the measured one is not
    assert value["k3"] == pytest.approx(TRUE["k3"], rel=0.05)
    assert value["k4"] * value["k2"] / value["k1"] == pytest.approx(
        TRUE["k4"] * TRUE["k2"] / TRUE["k1"], rel=0.05
    )
    assert all(e.low < TRUE[name] < e.high for name, e in found.params.items())
    assert found.prediction_error[-1].horizon_s == 10 * DT


def test_a_robot_that_stands_still_before_its_first_command_was_sent_nothing(tmp_path):
    w = Workspace(make(tmp_path / "v", config=SEPARATE).folder)
    starts = {}
    for speed in (0.0, 0.4):
        path = published_when_touched(tmp_path / f"{speed}.mcap", speed)
        w.ingest(path, data=True)
        trial = w.trials()[-1].trial
        starts[speed] = (trial.states[0, 0], trial.start_inputs)
    assert starts[0.0][0] == pytest.approx(0.3, abs=0.01) and starts[0.0][1] == pytest.approx([0])
    assert starts[0.4][0] > 0.6 and starts[0.4][1][0] > 0  # with its first command as that before


def test_commands_that_come_on_another_grid_than_dt_are_told(tmp_path):
    w = Workspace(make(tmp_path / "v", config=SEPARATE.replace("dt = 0.05", "dt = 0.02")).folder)
    rows = np.column_stack([0.02 * np.arange(41), np.zeros((41, 2))])
    named = {"delimiter": ",", "header": "t,x,v", "comments": ""}
    np.savetxt(w.folder / "target.csv", rows, **named)
    notes = w.ingest(published_when_touched(tmp_path / "a.mcap", 0.0), data=True).notes
    assert any("0.05 s" in note and "0.02" in note for note in notes)


SEPARATE = CONFIG + (
    '[log]\nclock = "publish"\n[log.state.x]\npath = "/state.x"\n[log.state.v]\n'
    'path = "/state.v"\n[log.input.force]\npath = "/sent.force"\n'
)


def published_when_touched(path, speed):
    """A log of 1 s at a constant speed, then 8 s of a joystick's whole numbers every 50 ms."""
    rng = np.random.default_rng(0)
    t = np.arange(0, 9, 0.02)
    v = speed + 0.5 * np.clip(t - 1, 0, None)
    x = 0.3 + speed * t + 0.25 * np.clip(t - 1, 0, None) ** 2 + rng.normal(0, 0.002, len(t))
    sent = np.arange(1, 9, 0.05)
    force = np.round(2 + np.sin(np.floor(sent / 0.35))) + 1.0
    with path.open("wb") as stream:
        log = McapWriter(stream)
        state, command = (
            log.doubles("/state", "S", ["x", "v"]),
            log.doubles("/sent", "F", ["force"]),
        )
        for k, row in enumerate(encode_doubles(np.column_stack([x, v]))):
            log.message(state, 10**18 + k * 20_000_000, row)
        for k, row in enumerate(encode_doubles(force[:, None])):
            log.message(command, 10**18 + 10**9 + k * 50_000_000, row)
        log.finish()
    return path
