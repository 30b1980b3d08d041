"""A boat with thrusters, as engineers wrote it: no roles at first, another dt, plugs exchanged."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest

from cli import grounded
from facts import holding, holds
from grounded import places
from grounded.accounts.judge import judge
from grounded.errors import GroundedError, NextCommand
from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.starting.shapes import Drive, path_target
from grounded_trials.store.trial_file import write_trial
from workspaces import make

MODEL = """import numpy as np
from grounded import Model, Param
model = Model(
    states={"x": "m", "y": "m", "psi": "rad", "u": "m/s", "v": "m/s", "r": "rad/s"},
    inputs={"left": "1", "right": "1"},
    params={"a": Param(1.0, "m/s^2", 0.2, 3.0), "b": Param(2.0, "rad/s^2", 0.2, 6.0)},
    angles=("psi",),
    derivative=lambda s, a, p: {
        "x": s.u * np.cos(s.psi) - s.v * np.sin(s.psi),
        "y": s.u * np.sin(s.psi) + s.v * np.cos(s.psi),
        "psi": s.r,
        "u": p.a * (a.left + a.right) - 0.9 * s.u,
        "v": -1.2 * s.v - 0.3 * s.r,
        "r": p.b * (a.right - a.left) - 2.0 * s.r,
    },
)
"""
ROLES = 'roles={"position": ("x", "y"), "heading": "psi", "speed": "u"}'
CONFIG = """[model]
file = "model.py"
[task]
dt = 0.05
horizon = 60
target = "target.csv"
[reward]
state = { x = 1.0, y = 1.0, u = 1.0, v = 1.0 }
[limits]
left = [-1.0, 1.0]
right = [-1.0, 1.0]
"""
T = 0.05 * np.arange(61)
DRIVEN = "t,x,y,u,v\n" + "\n".join(f"{t:.2f},{3 * t:.3f},{t:.3f},{t:.3f},{t / 9:.4f}" for t in T)


@pytest.fixture
def w(tmp_path):
    return Workspace(make(tmp_path / "w", config=CONFIG, model=MODEL, target=DRIVEN).folder)


def driven(w, seed=0, crossed=False, scale=1.0):
    """Return 120 steps of the boat under varied commands, its sensors a little noisy."""
    model, rng = w.base_model, np.random.default_rng(seed)
    sent = np.repeat(rng.uniform(-0.4, 1.0, (15, 2)), 8, axis=0)
    x, states = np.zeros(6), []
    for u in sent:
        states.append(x + rng.normal(0, 2e-3, 6))
        x = model.system.step(x[None], scale * u[None, :: -1 if crossed else 1], model.values, 0.05)
        x = x[0]
    states.append(x)
    names = (model.state_names, model.input_names)
    return Trial(np.array(states), sent, 0.05, *names, id=f"t{seed + 1:04d}")


def test_roles_are_offered_as_the_equations_have_them(w):
    """`"speed": "v"`, it said to a boat whose v is sway: pasted, its target had the sway drive."""
    with pytest.raises(GroundedError, match=holding(ROLES)):
        path_target("circle", Drive(), w.base_model, 0.05)
    odd = replace(w.base_model, roles={"position": ("x", "y"), "heading": "psi", "speed": "v"})
    with pytest.raises(GroundedError, match=holding("'speed' for v", "across", '"speed": "u"')):
        path_target("circle", Drive(), odd, 0.05)
    named = replace(odd, roles={**odd.roles, "speed": "u"})
    assert {"x", "y", "psi", "u"} == set(path_target("circle", Drive(), named, 0.05))


def test_a_heading_without_a_declared_angle_is_one_all_the_same(w, tmp_path):
    """Neither Coriolis forces nor a drift over the ground were tried: "no known effect"."""
    model = w.base_model
    bare = replace(model, angles=())
    for one in (model, bare):
        assert places.body_velocity(one) == ("u", "v") and places.plane(one) == ["x+y"]
    assert places.undeclared_angles(bare) == ["psi"] and not places.undeclared_angles(model)
    (tmp_path / "model.py").write_text(MODEL.replace('angles=("psi",),', ""))
    trial, log = driven(w), tmp_path / "hand.csv"
    table = np.column_stack([0.05 * np.arange(120), trial.states[:-1], trial.inputs])
    names = [*model.state_names, *model.input_names]
    np.savetxt(log, table, "%.6f", ",", header=",".join(["t", *names]), comments="")
    folder = tmp_path / "begun"
    made = grounded("init", folder, "--from", log, "--model", tmp_path / "model.py", "--yes")
    told = " ".join((made.out + made.err).split())
    assert made.code == 0 and holds(told, "psi is an angle", 'angles=("psi",)')


@pytest.mark.parametrize("chosen", [False, True])
def test_weights_of_a_target_before_roles_were_added_are_nobody_s_choice(w, chosen):
    """Kept as "chosen", without a word: the next plan ended 260 mm off."""
    toml = w.folder / "grounded.toml"
    w.target({"x": 3 * T, "y": T, "u": T, "v": T / 9})
    before = tomllib.loads(toml.read_text())["reward"]["state"]
    if chosen:
        toml.write_text(toml.read_text().replace(f"y = {before['y']:g}", "y = 7.5"))
    file = w.folder / "model.py"
    file.write_text(file.read_text().replace('angles=("psi",),', f'angles=("psi",), {ROLES},'))
    done = grounded("-C", w.folder, "target", "circle", "--size", "1")
    now = tomllib.loads(toml.read_text())["reward"]["state"]
    assert (now.get("y") == 7.5) == chosen and (set(now) == {"x", "y", "psi", "u"}) != chosen
    told = " ".join(done.err.split())
    assert holds(told, "[reward] state is kept", "y = 7.500") == chosen


def test_logs_of_another_dt_are_told_as_left_out(w):
    """A log by hand, the only varied one, was in no later diagnosis, and nothing said so."""
    write_trial(w.folder / "hand.mcap", driven(w), {"kind": "trial"})
    w.ingest(w.folder / "hand.mcap", data=True)
    assert not any("left out" in one or "leave" in one for one in w.status().notes)
    toml = w.folder / "grounded.toml"
    toml.write_text(toml.read_text().replace("dt = 0.05", "dt = 0.1"))
    w.target({"x": 3 * T, "y": T})
    (told,) = [one for one in Workspace(w.folder).status().notes if "leave it out" in one]
    assert holds(told, "t0001 was sampled every 0.05 s", "dt is 0.1 s now", "`discard`")


@pytest.mark.parametrize("crossed", [False, True])
@pytest.mark.parametrize("scale", [0.8, 1.0])
def test_inputs_that_acted_in_each_other_s_place_are_told_by_the_motion(w, crossed, scale):
    """Of nine runs with exchanged plugs, one was named; the others were asked about."""
    told = judge(w.base_model, [driven(w, 3, crossed, scale)], range(6)).told
    assert [(one.account.kind, one.account.pairs) for one in told] == (
        [("exchange", ((6, 7),))] if crossed else []
    )


def test_who_proposes_at_the_end_of_a_search_has_gone_on_with_the_run(w, monkeypatch):
    """`propose goes on`: it said so again and again, and asked for the discard each time."""
    from grounded.search.standing import Proposal
    from grounded_trials.workspace.candidates import proposing

    write_trial(w.folder / "hand.mcap", driven(w), {"kind": "trial"})
    w.ingest(w.folder / "hand.mcap", data=True)
    digest = w.store.find("t0001").digest
    asked = ("t0001: why",), NextCommand("discard", ("t0001",))
    monkeypatch.setattr(
        "grounded_trials.workspace.intake.remarks.gone_wrong.unanswered",
        lambda here: ((), None) if digest in here.noted.kept else asked,
    )
    ended = Proposal(w.status().standing, None, False)
    monkeypatch.setattr(proposing, "_handed_over", lambda here: (ended, {}))
    assert w.propose().then.verb != "discard" and digest in w.noted.kept
