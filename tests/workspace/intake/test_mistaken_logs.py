"""Commands exchanged or in percent, quaternions, other scales, and limits: told at ingest."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cli import grounded
from facts import holds, of_code
from grounded import Model, Trial
from grounded.errors import GroundedError, NextCommand
from grounded.onboard import Runner
from grounded.plant import Plant
from grounded.result import listed
from grounded_trials import Workspace
from grounded_trials.store.trial_file import read_trial, write_trial
from grounded_trials.workspace.intake.log_faults import column_faults
from grounded_trials.workspace.intake.opening.foreign import mapping_of, read_foreign
from grounded_trials.workspace.intake.recognise import stories_of_log
from recorded import LOGGED, record
from ros_bags import rover_bag
from stepped import logged, stepped
from workspaces import CONFIG, MODEL, make

TWIN = """import numpy as np
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


TWIN_CONFIG = """[model]
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
TIMES = np.arange(101) * 0.05
TARGET = "t,v,psi\n" + "\n".join(f"{t:.2f},{0.3 * t:.4f},{0.2 * t:.4f}" for t in TIMES) + "\n"


@pytest.fixture
def twin(tmp_path):
    return Workspace(make(tmp_path / "w", config=TWIN_CONFIG, model=TWIN, target=TARGET).folder)


def log(twin, path, scale=1.0, columns=("port", "starboard"), seed=0):
    """300 steps of the robot, whose parameters are a little off, as a table."""
    model, rng = twin.base_model, np.random.default_rng(seed)
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


def run_crossed(twin):
    """Plan a candidate and run it on a robot whose commands arrive at each other's motor."""
    plan, model = twin.propose().candidate, twin.base_model

    def crossed(s, a, p):
        return model.derivative(s, SimpleNamespace(port=a.starboard, starboard=a.port), p)

    ran = Plant(replace(model, derivative=crossed)).run(
        plan.policy, dict.fromkeys(["v", "r", "psi"], 2e-3), RNG
    )
    return plan, ran, [0.05 * np.arange(ran.steps), ran.states[:-1]]


def in_percent(twin):
    """The workspace with a scale of 0.01 at both commands."""
    toml = twin.folder / "grounded.toml"
    text = toml.read_text()
    for name in ("port", "starboard"):
        text = text.replace(f'"/csv.{name}" }}', f'"/csv.{name}", scale = 0.01 }}')
    toml.write_text(text)
    return Workspace(twin.folder)


def test_exchanged_commands_are_told_at_once_and_stop_a_diagnosis(twin, tmp_path):
    for k in range(2):
        path = log(twin, tmp_path / f"{k}.csv", columns=("starboard", "port"), seed=k)
        told, *_ = twin.ingest(path, data=True).findings
        assert (told.code, told.about) == ("log.exchange", ("port", "starboard"))
        assert told.facts["trials"] == (f"t000{k + 1}",)
    done = grounded("-C", twin.folder, "diagnose")
    said = " ".join(done.err.replace("\\\n", " ").split())  # wherever the command was wrapped
    assert done.code == 1 and holds(said, "port and starboard", "discard t0001 t0002")
    with pytest.raises(GroundedError, match="exchanged"):
        Workspace(twin.folder).preflight()


def test_an_exchange_that_earlier_logs_do_not_show_is_the_robot_s(twin, tmp_path):
    twin.ingest(log(twin, tmp_path / "a.csv"), data=True)
    other = log(twin, tmp_path / "b.csv", columns=("starboard", "port"), seed=1)
    told, *_ = twin.ingest(other, data=True).findings
    assert (told.code, told.about) == ("run.exchanged", ("port", "starboard"))
    assert told.facts["proven"] == ("t0001",) and told.facts["parts"] == "wires"
    assert twin.discard("t0002").then.verb != "ingest"


def test_a_run_with_its_motors_exchanged_is_to_be_run_again_with_the_same_log_table(twin, tmp_path):
    toml = twin.folder / "grounded.toml"
    text = toml.read_text().replace("/csv.port", "/csv.m1").replace("/csv.starboard", "/csv.m2")
    toml.write_text(text)
    twin.ingest(log(twin, tmp_path / "a.csv", columns=("m1", "m2")), data=True)
    plan, ran, seen = run_crossed(twin)
    path = written(tmp_path / "run.csv", np.column_stack([*seen, ran.inputs]), "m1", "m2")
    found = twin.ingest(path)
    (told,) = of_code(found, "run.exchanged")
    assert found.then.verb == "discard" and "proven" in told.facts
    assert twin.discard(found.trial).then == NextCommand("run")  # by its [system]
    known = twin.ingest(path)
    assert known.then == twin.status().then and any(f"run {plan.id}" in s for s in known.warnings)

    text = text.replace("/csv.m1", "/csv.A").replace("/csv.m2", "/csv.m1")
    toml.write_text(text.replace("/csv.A", "/csv.m2"))
    with pytest.raises(GroundedError) as refused:
        Workspace(twin.folder).ingest(path)
    assert refused.value.finding.code == "run.exchanged"
    assert refused.value.then == NextCommand("next", ("LOG",))


def test_a_log_in_a_wrong_unit_is_ingested_again_once_it_is_discarded(twin, tmp_path):
    path = log(twin, tmp_path / "a.csv", scale=100.0)
    twin.ingest(path, data=True)
    twin.discard("t0001")
    again = in_percent(twin).ingest(path, data=True)
    assert (again.trial, again.warnings) == ("t0002", ())


def test_percent_is_told_with_the_scale_and_a_scale_mends_it(twin, tmp_path):
    path = log(twin, tmp_path / "a.csv", scale=100.0)
    told, *_ = twin.ingest(path, data=True).findings
    assert (told.code, told.facts["unit"], told.facts["by"]) == ("log.unit", "percent", 0.01)
    with pytest.raises(GroundedError) as stopped:
        twin.diagnose()
    assert stopped.value.then is not None and stopped.value.then.verb == "discard"
    twin.discard("t0001")
    again = in_percent(twin)
    assert not again.ingest(path, data=True).warnings and again.preflight() == ()


def test_a_run_with_exchanged_commands_names_them(twin, tmp_path):
    plan = twin.propose().candidate
    twin.run()
    trial = read_trial(next((twin.folder / "runs").iterdir()))[0]
    t = trial.dt * np.arange(trial.steps)
    table = np.column_stack([t, trial.states[:-1], trial.inputs])
    path = written(tmp_path / "run.csv", table, "starboard", "port")
    with pytest.raises(GroundedError) as refused:
        twin.ingest(path)
    said = str(refused.value)
    assert holds(said, plan.id, "port", "starboard") and "somebody" not in said
    recording = read_foreign(twin, path, mapping_of(twin, path)).recording
    found = min(stories_of_log(recording, twin.task, plan, None), key=lambda one: one.left)
    assert (found.finding.code, found.names) == ("log.exchange", ("port", "starboard"))
    toml = twin.folder / "grounded.toml"
    toml.write_text(
        toml.read_text()
        .replace('port = { path = "/csv.port" }', 'port = { path = "/csv.A" }')
        .replace('starboard = { path = "/csv.starboard" }', 'starboard = { path = "/csv.port" }')
        .replace("/csv.A", "/csv.starboard")
    )
    assert Workspace(twin.folder).ingest(path).candidate == plan.id


def test_outputs_that_a_program_exchanged_are_mended_there(twin, tmp_path):
    twin.ingest(log(twin, tmp_path / "a.csv"), data=True)
    _, ran, seen = run_crossed(twin)
    with pytest.raises(GroundedError) as refused:
        twin.ingest(written(tmp_path / "run.csv", np.column_stack([*seen, ran.inputs[:, ::-1]])))
    told = refused.value.finding
    assert told.code == "run.exchanged" and told.facts["proven"]
    assert refused.value.then == NextCommand("next", ("LOG",))


def driven_by(twin, path, action):
    """Write the log of a run whose program sends action(k, the states as they are logged)."""
    model, x, rows = twin.base_model, twin.task.start.copy(), []
    for k in range(twin.task.horizon):
        logged = x + RNG.normal(0, 1e-3, 3)
        u = action(k, logged)
        rows.append([k * twin.task.dt, *logged, *u])
        x = model.system.step(x[None], u[None], model.values, twin.task.dt)[0]
    return twin.ingest(written(path, rows))


@pytest.mark.parametrize("waits", [0, 8])
def test_a_program_whose_clock_began_with_the_log_is_told(twin, tmp_path, waits):
    plan, dt = twin.propose().candidate, twin.task.dt
    runner = Runner(plan.policy)

    def action(k, logged):
        return runner.action(k * dt, logged) if k >= waits else np.zeros(2)

    found = driven_by(twin, tmp_path / "run.csv", action)
    told = of_code(found, "run.unsent")
    assert [one.facts["steps"] for one in told] == [8] * (waits > 0)
    assert (waits > 0) == (found.then.verb == "discard")


@pytest.mark.parametrize("fault", ["program", "log"])
def test_a_program_that_sends_an_input_with_the_other_sign_is_told(twin, tmp_path, fault):
    plan, dt, wrong = twin.propose().candidate, twin.task.dt, np.array([1.0, -1.0])
    runner, path = Runner(plan.policy), tmp_path / "run.csv"
    if fault == "program":
        with pytest.raises(GroundedError) as refused:
            driven_by(twin, path, lambda k, logged: wrong * runner.action(k * dt, logged))
        told = refused.value.finding
        assert refused.value.then == NextCommand("next", ("LOG",))
        assert (told.code, told.about, told.facts["times"]) == ("run.sends", ("starboard",), -1)
        return
    driven_by(twin, path, lambda k, logged: runner.action(k * dt, logged))
    twin.discard("t0001")
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    rows[:, 5] *= -1
    with pytest.raises(GroundedError) as refused:
        twin.ingest(written(path, rows))
    assert holds(str(refused.value), "starboard", "sign in [log.input.starboard]")


@pytest.mark.parametrize("named", [False, True])
def test_states_from_another_origin_are_told_with_their_offsets(twin, tmp_path, named):
    """A zero that a program set where its boat floated: "somebody drove", and no word of it."""
    plan, dt, off = twin.propose().candidate, twin.task.dt, np.array([0.3, 0.0, -0.45])
    runner, path = Runner(plan.policy), tmp_path / "run.csv"
    with pytest.raises(GroundedError) as refused:
        driven_by(twin, path, lambda k, logged: runner.action(k * dt, logged + off))
    if not named:
        assert refused.value.finding.code == "run.origin"
        assert refused.value.finding.facts["off"] == ("v 0.30 m/s", "psi -0.45 rad")
        assert refused.value.then == NextCommand("next", ("LOG",))
        return
    found = twin.ingest(path, candidate=plan.id)
    assert found.findings[0].code == "run.origin" and found.then.verb == "discard"


def test_a_part_of_a_quaternion_is_told_wherever_it_is_read(tmp_path):
    log, w = rover_bag(tmp_path / "bag"), tmp_path / "w"
    grounded("init", w, "--from", log, "--json")
    toml, angle, part = w / "grounded.toml", "orientation.@rpy.yaw", "orientation.z"

    def told():
        said = grounded("-C", w, "inspect", log, "--json").json["remarks"]
        found = [one.finding for one in Workspace(w).preflight()]
        return [any(holds(one, part, angle) for one in some) for some in (said, found)]

    assert not any(part in one for one in Workspace(w).ingest(log, data=True).warnings)
    assert told() == [False, False]
    toml.write_text(toml.read_text().replace(angle, part))
    grounded("-C", w, "discard", "t0001")
    (warning,) = (s for s in Workspace(w).ingest(log, data=True).warnings if part in s)
    assert holds(warning, "psi", "quaternion", angle)
    assert told() == [True, True]


def test_a_command_in_degrees_is_named_with_its_own_table():
    boat = Model(
        states={"psi": "rad", "r": "rad/s"},
        inputs={"rudder": "rad"},
        derivative=lambda s, a, p: {"psi": s.r, "r": (0.6 * a.rudder - s.r) / 0.8},
        angles=("psi",),
    )
    rudder = 0.3 * np.sign(np.sin(0.9 * np.arange(400) * 0.1))
    rng, x = np.random.default_rng(1), stepped(boat, rudder, 0.1)
    trial = logged(boat, x, np.degrees(rudder), 0.1, 1e-3, rng)
    (fault,) = column_faults(SimpleNamespace(base_model=boat), trial)
    assert (fault.code, fault.about) == ("log.unit", ("rudder",))
    assert fault.facts["by"] == pytest.approx(1 / 57.29578)
    assert holds(fault.sentence, "[log.input.rudder]", "0.017453293")


NARROW = CONFIG.replace("force = [-5.0, 5.0]", "force = [0.0, 1.17]")
T = np.arange(200) * 0.05


def driven(most, low=0.0):
    force = low + (most - low) * (0.5 - 0.5 * np.cos(2 * T))[:, None]
    states = np.column_stack([np.zeros(201), np.zeros(201)])
    return Trial(states, force, 0.05, ("x", "v"), ("force",))


@pytest.fixture
def w(tmp_path):
    assert NARROW != CONFIG
    return Workspace(make(tmp_path / "w", config=NARROW).folder)


@pytest.mark.parametrize("most, said", [(2.15, True), (1.175, False)])
def test_data_beyond_the_limits_are_told_how_far(w, tmp_path, most, said):
    write_trial(tmp_path / "d.mcap", driven(most), {"kind": "data"})
    told = of_code(w.ingest(tmp_path / "d.mcap", data=True), "log.limits")
    assert [(one.about, one.facts["how"]) for one in told] == [(("force",), "widen")] * said
    assert [one.facts["most"].value for one in told] == pytest.approx(
        [most - 1.17] * said, rel=1e-3
    )
    assert all(holds(one.sentence, "force", "0 to 1.17 N") for one in told)


def test_a_plan_and_a_target_name_the_log_whose_range_the_limits_are(tmp_path):
    config = CONFIG.replace("force = [-5.0, 5.0]", 'force = [-5, 5]\nseen_in = "a.csv"')
    w = Workspace(make(tmp_path / "w", config=config).folder)
    drawn = grounded("-C", w.folder, "target", "line", "--to", "x=1", "--json").json
    (told,) = (one for one in drawn["findings"] if one["code"] == "plan.limits_of_log")
    (again,) = of_code(w.propose(), "plan.limits_of_log")
    assert told["facts"]["log"] == again.facts["log"] == "a.csv"


@pytest.mark.slow
@pytest.mark.parametrize(
    "names, factor",
    [
        ("psi r", -1.0),  # an IMU that is mounted upside down
        ("port starboard", 1e3),  # in mV, both
    ],
)
def test_the_columns_and_their_factor_are_named(twin, tmp_path, names, factor):
    w = twin
    w.propose()
    trial, meta, _ = read_trial(w.run().trial_file)
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
