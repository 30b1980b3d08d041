"""Logs with two commands exchanged, or in percent: told at ingest, and before a diagnosis."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cli import grounded
from facts import holds, of_code
from grounded.errors import GroundedError, NextCommand
from grounded.onboard import Runner
from grounded.plant import Plant
from grounded_trials import Workspace
from grounded_trials.store.trial_file import read_trial
from grounded_trials.workspace.intake.opening.foreign import mapping_of, read_foreign
from grounded_trials.workspace.intake.recognise import stories_of_log
from workspaces import make

MODEL = """import numpy as np
from grounded import Model, Param
model = Model(
    states={"v": "m/s", "r": "rad/s", "psi": "rad"},
    inputs={"port": "1", "starboard": "1"},
    params={"gain": Param(1.0, "m/s^2", 0.2, 3.0), "arm": Param(0.6, "1/m", 0.1, 2.0)},
    angles=("psi",),
    derivative=lambda s, a, p: {
        "v": p.gain * (a.port + a.starboard) - 0.8 * s.v,
        "r": p.gain * p.arm * (a.starboard - a.port) - 1.2 * s.r,
        "psi": s.r,
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
state = { v = 1.0, psi = 1.0 }
input = { port = 0.01, starboard = 0.01 }
input_change = { port = 0.01, starboard = 0.01 }
[limits]
port = [-1.0, 1.0]
starboard = [-1.0, 1.0]
[system]
model = "model.py"
[log]
state = { v = { path = "/csv.v" }, r = { path = "/csv.r" }, psi = { path = "/csv.psi" } }
input = { port = { path = "/csv.port" }, starboard = { path = "/csv.starboard" } }
"""
RNG = np.random.default_rng(0)


T = np.arange(101) * 0.05
TARGET = "t,v,psi\n" + "\n".join(f"{t:.2f},{0.3 * t:.4f},{0.2 * t:.4f}" for t in T) + "\n"


@pytest.fixture
def w(tmp_path):
    return Workspace(make(tmp_path / "w", config=CONFIG, model=MODEL, target=TARGET).folder)


def log(w, path, scale=1.0, columns=("port", "starboard"), seed=0):
    """300 steps of the robot, whose parameters are a little off, as a table."""
    model, rng = w.base_model, np.random.default_rng(seed)
    sent = np.repeat(rng.uniform(-0.6, 1.0, (30, 2)), 10, axis=0)
    x, rows = np.zeros(3), []
    for k, u in enumerate(sent):
        rows.append([0.05 * k, *(x + rng.normal(0, 2e-3, 3)), *(scale * u)])
        x = model.system.step(x[None], u[None] * [0.9, 1.1], model.values, 0.05)[0]
    return written(path, rows, *columns)


def written(path, rows, *columns):
    """Write rows of t, v, r, psi and two commands as a table, the commands called as they say."""
    head = ",".join(("t", "v", "r", "psi", *(columns or ("port", "starboard"))))
    np.savetxt(path, rows, "%.9f", ",", header=head, comments="")
    return path


def run_crossed(w):
    """Plan a candidate and run it on a robot whose commands arrive at each other's motor."""
    plan, model = w.propose().candidate, w.base_model

    def crossed(s, a, p):
        return model.derivative(s, SimpleNamespace(port=a.starboard, starboard=a.port), p)

    ran = Plant(replace(model, derivative=crossed)).run(
        plan.policy, dict.fromkeys(["v", "r", "psi"], 2e-3), RNG
    )
    return plan, ran, [0.05 * np.arange(ran.steps), ran.states[:-1]]


def in_percent(w):
    """The workspace with a scale of 0.01 at both commands."""
    toml = w.folder / "grounded.toml"
    text = toml.read_text()
    for name in ("port", "starboard"):
        text = text.replace(f'"/csv.{name}" }}', f'"/csv.{name}", scale = 0.01 }}')
    toml.write_text(text)
    return Workspace(w.folder)


def test_exchanged_commands_are_told_at_once_and_stop_a_diagnosis(w, tmp_path):
    for k in range(2):
        path = log(w, tmp_path / f"{k}.csv", columns=("starboard", "port"), seed=k)
        told, *_ = w.ingest(path, data=True).findings
        assert (told.code, told.about) == ("log.exchange", ("port", "starboard"))
        assert told.facts["trials"] == (f"t000{k + 1}",)
    done = grounded("-C", w.folder, "diagnose")
    said = " ".join(done.err.replace("\\\n", " ").split())  # wherever the command was wrapped
    assert done.code == 1 and holds(said, "port and starboard", "discard t0001 t0002")
    with pytest.raises(GroundedError, match="exchanged"):
        Workspace(w.folder).preflight()


def test_an_exchange_that_earlier_logs_do_not_show_is_the_robot_s(w, tmp_path):
    w.ingest(log(w, tmp_path / "a.csv"), data=True)
    other = log(w, tmp_path / "b.csv", columns=("starboard", "port"), seed=1)
    told, *_ = w.ingest(other, data=True).findings
    assert (told.code, told.about) == ("run.exchanged", ("port", "starboard"))
    assert told.facts["proven"] == ("t0001",) and told.facts["parts"] == "wires"
    assert w.discard("t0002").then.verb != "ingest"


def test_a_run_with_its_motors_exchanged_is_to_be_run_again_with_the_same_log_table(w, tmp_path):
    toml = w.folder / "grounded.toml"
    text = toml.read_text().replace("/csv.port", "/csv.m1").replace("/csv.starboard", "/csv.m2")
    toml.write_text(text)
    w.ingest(log(w, tmp_path / "a.csv", columns=("m1", "m2")), data=True)
    plan, ran, seen = run_crossed(w)
    path = written(tmp_path / "run.csv", np.column_stack([*seen, ran.inputs]), "m1", "m2")
    found = w.ingest(path)
    (told,) = of_code(found, "run.exchanged")
    assert found.then.verb == "discard" and "proven" in told.facts
    assert w.discard(found.trial).then == NextCommand("run")  # by its [system]
    known = w.ingest(path)
    assert known.then == w.status().then and any(f"run {plan.id}" in s for s in known.warnings)

    text = text.replace("/csv.m1", "/csv.A").replace("/csv.m2", "/csv.m1")
    toml.write_text(text.replace("/csv.A", "/csv.m2"))
    with pytest.raises(GroundedError) as refused:
        Workspace(w.folder).ingest(path)
    assert refused.value.finding.code == "run.exchanged"
    assert refused.value.then == NextCommand("next", ("LOG",))


@pytest.mark.parametrize(("most", "wrong"), [(100.0, True), (1.0, False)])
def test_limits_in_the_wrong_unit_of_a_log_are_told_with_the_right_ones(tmp_path, most, wrong):
    config = CONFIG.replace("[-1.0, 1.0]", f"[-{most}, {most}]")
    w = Workspace(make(tmp_path / "w", config=config, model=MODEL, target=TARGET).folder)
    told, *_ = w.ingest(log(w, tmp_path / "a.csv", scale=100.0), data=True).findings
    right = ("port = [-1, 1]", "starboard = [-1, 1]")
    assert told.facts["limits"] == (right if wrong else ())


def test_a_log_in_a_wrong_unit_is_to_be_ingested_again_once_it_is_discarded(
    w, tmp_path, monkeypatch
):
    path = log(w, tmp_path / "a.csv", scale=100.0)
    w.ingest(path, data=True)
    (tmp_path / "b").mkdir()
    monkeypatch.chdir(tmp_path / "b")
    done = w.discard("t0001")
    assert done.then == NextCommand("ingest", ("../a.csv", "--data"))
    said = grounded("-C", w.folder, "discard", "t0001").out.replace("\\\n", "").split()
    assert said[-3:] == ["ingest", *done.then.arguments]
    again = in_percent(w).ingest(path, data=True)
    assert (again.trial, again.warnings) == ("t0002", ())
    assert Workspace(w.folder).discard("t0002").then == NextCommand("status")


def test_percent_is_told_with_the_scale_and_a_scale_mends_it(w, tmp_path):
    path = log(w, tmp_path / "a.csv", scale=100.0)
    told, *_ = w.ingest(path, data=True).findings
    assert (told.code, told.facts["unit"], told.facts["by"]) == ("log.unit", "percent", 0.01)
    with pytest.raises(GroundedError) as stopped:
        w.diagnose()
    assert stopped.value.then is not None and stopped.value.then.verb == "discard"
    w.discard("t0001")
    again = in_percent(w)
    assert not again.ingest(path, data=True).warnings and again.preflight() == ()


def test_a_run_with_exchanged_commands_names_them(w, tmp_path):
    plan = w.propose().candidate
    w.run()
    trial = read_trial(next((w.folder / "runs").iterdir()))[0]
    t = trial.dt * np.arange(trial.steps)
    table = np.column_stack([t, trial.states[:-1], trial.inputs])
    path = written(tmp_path / "run.csv", table, "starboard", "port")
    with pytest.raises(GroundedError) as refused:
        w.ingest(path)
    said = str(refused.value)
    assert holds(said, plan.id, "port", "starboard") and "somebody" not in said
    recording = read_foreign(w, path, mapping_of(w, path)).recording
    found = min(stories_of_log(recording, w.task, plan, None), key=lambda one: one.left)
    assert (found.finding.code, found.names) == ("log.exchange", ("port", "starboard"))
    toml = w.folder / "grounded.toml"
    toml.write_text(
        toml.read_text()
        .replace('port = { path = "/csv.port" }', 'port = { path = "/csv.A" }')
        .replace('starboard = { path = "/csv.starboard" }', 'starboard = { path = "/csv.port" }')
        .replace("/csv.A", "/csv.starboard")
    )
    assert Workspace(w.folder).ingest(path).candidate == plan.id


def test_outputs_that_a_program_exchanged_are_mended_there(w, tmp_path):
    w.ingest(log(w, tmp_path / "a.csv"), data=True)
    _, ran, seen = run_crossed(w)
    with pytest.raises(GroundedError) as refused:
        w.ingest(written(tmp_path / "run.csv", np.column_stack([*seen, ran.inputs[:, ::-1]])))
    told = refused.value.finding
    assert told.code == "run.exchanged" and told.facts["proven"]
    assert refused.value.then == NextCommand("next", ("LOG",))


def driven_by(w, path, action):
    """Write the log of a run whose program sends action(k, the states as they are logged)."""
    model, x, rows = w.base_model, w.task.start.copy(), []
    for k in range(w.task.horizon):
        logged = x + RNG.normal(0, 1e-3, 3)
        u = action(k, logged)
        rows.append([k * w.task.dt, *logged, *u])
        x = model.system.step(x[None], u[None], model.values, w.task.dt)[0]
    return w.ingest(written(path, rows))


@pytest.mark.parametrize("waits", [0, 8])
def test_a_program_whose_clock_began_with_the_log_is_told(w, tmp_path, waits):
    plan, dt = w.propose().candidate, w.task.dt
    runner = Runner(plan.policy)

    def action(k, logged):
        return runner.action(k * dt, logged) if k >= waits else np.zeros(2)

    found = driven_by(w, tmp_path / "run.csv", action)
    told = of_code(found, "run.unsent")
    assert [one.facts["steps"] for one in told] == [8] * (waits > 0)
    assert (waits > 0) == (found.then.verb == "discard")


@pytest.mark.parametrize("fault", ["program", "log"])
def test_a_program_that_sends_an_input_with_the_other_sign_is_told(w, tmp_path, fault):
    plan, dt, wrong = w.propose().candidate, w.task.dt, np.array([1.0, -1.0])
    runner, path = Runner(plan.policy), tmp_path / "run.csv"
    if fault == "program":
        with pytest.raises(GroundedError) as refused:
            driven_by(w, path, lambda k, logged: wrong * runner.action(k * dt, logged))
        told = refused.value.finding
        assert refused.value.then == NextCommand("next", ("LOG",))
        assert (told.code, told.about, told.facts["times"]) == ("run.sends", ("starboard",), -1)
        return
    driven_by(w, path, lambda k, logged: runner.action(k * dt, logged))
    w.discard("t0001")
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    rows[:, 5] *= -1
    with pytest.raises(GroundedError) as refused:
        w.ingest(written(path, rows))
    assert holds(str(refused.value), "starboard", "sign in [log.input.starboard]")


@pytest.mark.parametrize("named", [False, True])
def test_states_from_another_origin_are_told_with_their_offsets(w, tmp_path, named):
    """A zero that a program set where its boat floated: "somebody drove", and no word of it."""
    plan, dt, off = w.propose().candidate, w.task.dt, np.array([0.3, 0.0, -0.45])
    runner, path = Runner(plan.policy), tmp_path / "run.csv"
    with pytest.raises(GroundedError) as refused:
        driven_by(w, path, lambda k, logged: runner.action(k * dt, logged + off))
    if not named:
        assert refused.value.finding.code == "run.origin"
        assert refused.value.finding.facts["off"] == ("v 0.30 m/s", "psi -0.45 rad")
        assert refused.value.then == NextCommand("next", ("LOG",))
        return
    found = w.ingest(path, candidate=plan.id)
    assert found.findings[0].code == "run.origin" and found.then.verb == "discard"
