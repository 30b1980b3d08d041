"""A measured column times a constant: it was told that somebody took over."""

from dataclasses import replace

import numpy as np
import pytest

from facts import holds, of_code
from grounded import Model
from grounded.accounts.reported import scaled
from grounded.accounts.table import of_commands
from grounded.errors import GroundedError
from grounded.result import listed
from grounded.search.returned.stories import Kind, stories, unit_by_factor
from grounded.search.returned.who_drove import follows, latest
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


def test_an_encoder_of_one_joint_the_other_way_round_is_tried(tmp_path):
    """Neither all angles nor the position alone: its velocity turns with it."""
    arm = Model(
        states={"a": "rad", "b": "rad", "va": "rad/s", "vb": "rad/s"},
        inputs={"ta": "N m", "tb": "N m", "fan": "1"},
        derivative=lambda s, a, p: {"a": s.va, "b": s.vb, "va": a.ta, "vb": a.tb - s.vb},
    )
    tried = {(one.columns, one.factor) for one in of_commands(arm)}
    assert {((0, 2), -1.0), ((1, 3), -1.0)} <= tried
    assert {((4, 5), 1e-3), ((4, 5), 1e3)} <= tried


def test_centimetres_are_tried_and_are_no_percent():
    cart = Model(
        states={"x": "m", "v": "m/s"},
        inputs={"throttle": "1"},
        derivative=lambda s, a, p: {"x": s.v, "v": a.throttle - s.v},
    )
    tried = {(one.columns, one.factor) for one in of_commands(cart)}
    assert {((0, 1), 1e2), ((0,), 1e2)} <= tried
    assert unit_by_factor(cart, ("x", "v"), 1e-2) == "cm"
    assert unit_by_factor(cart, ("throttle",), 1e-2) == "percent"
    assert unit_by_factor(cart, ("x", "throttle"), 1e-2) == ""
    assert scaled(cart, ("x", "v"), 100.0, "cm").facts["by"] == 0.01


@pytest.mark.parametrize("seed", [0, 3])
def test_other_driving_is_no_factor(driven, seed):
    w, trial, _ = driven
    rng, (own, _) = np.random.default_rng(seed), w.candidate(trial.candidate)
    smooth = np.convolve(rng.normal(size=trial.steps + 20), np.ones(20) / 5, "valid")
    by_hand = np.array(trial.inputs)
    by_hand[:, seed % 2] = smooth[: trial.steps] * by_hand[:, seed % 2].std()
    if seed > 2:
        by_hand[: trial.steps // 2] = trial.inputs[: trial.steps // 2]  # somebody took over
    odd = replace(trial, inputs=by_hand)
    plain = follows(own.policy, odd, latest(w.task))
    assert plain is not None
    some = stories(w.task, own, odd, plain)
    assert not [one for one in some if one.kind is Kind.UNIT]


@pytest.mark.parametrize("before", [0.7])
def test_a_rate_that_is_logged_in_radians_for_a_model_in_degrees_is_told(tmp_path, before):
    model = MODEL.replace('"force": "N"', '"force": "deg/s"')
    w = Workspace(make(tmp_path / "w", config=LOGGED, model=model).folder)
    log = record(w, tmp_path / "a.csv", w.propose().candidate.policy, before)
    rows = np.loadtxt(log, delimiter=",", skiprows=1)
    rows[:, 3] = np.deg2rad(rows[:, 3])
    np.savetxt(log, rows, "%.6f", ",", header="t,x,v,force", comments="")
    with pytest.raises(GroundedError) as refused:
        w.ingest(log)
    assert holds(str(refused.value), "c0001", "force", "57.29578", "in rad/s")


@pytest.mark.parametrize("before", [0.7])
@pytest.mark.parametrize(("by", "named"), [(20.0, "percent of 5 N")])
def test_a_command_in_percent_of_its_limit_is_told(tmp_path, before, by, named):
    w = Workspace(make(tmp_path / "w", config=LOGGED).folder)
    log = record(w, tmp_path / "a.csv", w.propose().candidate.policy, before)
    rows = np.loadtxt(log, delimiter=",", skiprows=1)
    rows[:, 3] *= by
    np.savetxt(log, rows, "%.6f", ",", header="t,x,v,force", comments="")
    with pytest.raises(GroundedError) as refused:
        w.ingest(log)
    assert holds(str(refused.value), "c0001", "force", named, f"by {1 / by:g}", "[log.input.force]")
    assert refused.value.then.arguments == (str(log),)
