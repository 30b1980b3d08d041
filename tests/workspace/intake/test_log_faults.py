"""Columns of a log in another unit, of a quaternion, or beyond [limits]."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cli import grounded
from facts import holds, of_code
from grounded import Model, Trial
from grounded.errors import GroundedError
from grounded.result import listed
from grounded_trials import Workspace
from grounded_trials.store.trial_file import read_trial, write_trial
from grounded_trials.workspace.intake.log_faults import column_faults
from recorded import LOGGED, record
from ros_bags import rover_bag
from stepped import logged, stepped
from workspaces import CONFIG, MODEL, make


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


@pytest.mark.parametrize("limit, said", [(0.3, True), (5.0, False)])
def test_a_first_plan_that_its_limits_keep_from_the_target_says_so(tmp_path, limit, said):
    config = CONFIG.replace("force = [-5.0, 5.0]", f"force = [-5.0, {limit}]")
    findings = Workspace(make(tmp_path / "w", config=config).folder).propose().findings
    told = [one for one in findings if one.code == "plan.falls_short"]
    assert len(told) == said
    assert all(one.about == ("force",) for one in told)


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


ROVER_CONFIG = """[model]
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
def rover_run(tmp_path_factory):
    """A rover's workspace, and a run of its first candidate."""
    t = np.arange(121) * 0.05
    rows = np.column_stack([t, 3 * np.sin(t / 3), 3 - 3 * np.cos(t / 3), t / 3, 1 + 0 * t])
    text = "\n".join(",".join(f"{v:.6f}" for v in row) for row in rows)
    folder = tmp_path_factory.mktemp("w") / "w"
    made = make(folder, config=ROVER_CONFIG, model=ROVER, target=f"t,x,y,psi,u\n{text}\n")
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
def test_the_columns_and_their_factor_are_named(rover_run, tmp_path, names, factor):
    w, trial, meta = rover_run
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
