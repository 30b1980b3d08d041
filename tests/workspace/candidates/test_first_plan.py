"""What the first plan tells: what holds its start, what its target leaves free; the end."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest

from cli import grounded
from grounded import Model
from grounded.errors import NextCommand
from grounded.findings import Finding, found
from grounded.search import improve
from grounded.search.standing import Ending, Proposal, ended, standing
from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.starting.begin import begin
from grounded_trials.store.trial_file import read_trial, write_trial
from grounded_trials.workspace.candidates.at_rest import standstill
from grounded_trials.workspace.candidates.proposing import propose_in
from grounded_trials.workspace.candidates.running import run_candidate
from grounded_trials.workspace.candidates.search_state import standing_in
from grounded_trials.workspace.intake.ingest import ingest_log
from workspaces import blank, edit, make

HEAD = "from grounded import Model, Param\nfrom numpy import cos, sin\n"
LIFTED = f"""{HEAD}
def rate(s, a, p):
    return {{"h": s.v, "v": p.k * a.thrust - 9.81, "q": a.turn - s.q}}

model = Model({{"h": "m", "v": "m/s", "q": "deg/s"}}, {{"thrust": "1", "turn": "deg/s"}},
              params={{"k": Param(20.0, "m/s^2")}}, derivative=rate)
"""


BALL = f"""{HEAD}
def rate(s, a, p):
    return {{"x": s.v, "v": 7.0 * s.th, "th": s.w, "w": (0.4 * a.volt - s.w) / 0.07}}

model = Model({{"x": "m", "v": "m/s", "th": "rad", "w": "rad/s"}}, {{"volt": "V"}}, derivative=rate)
"""


PLANE = f"""{HEAD}
def rate(s, a, p):
    up, aside = p.k * a.thrust * cos(s.th), p.k * a.thrust * sin(s.th)
    return {{"x": s.vx, "z": s.vz, "th": a.turn, "vx": aside, "vz": up - 9.81}}

model = Model({{"x": "m", "z": "m", "th": "rad", "vx": "m/s", "vz": "m/s"}},
              {{"thrust": "1", "turn": "rad/s"}}, params={{"k": Param(20.0, "m/s^2")}},
              derivative=rate)
"""


CART = f"""{HEAD}
def rate(s, a, p):
    return {{"x": s.v, "v": (a.force - 0.3 * s.v) / p.M}}

model = Model({{"x": "m", "v": "m/s"}}, {{"force": "N"}},
              params={{"M": Param(1.0, "kg", 0.5, 2.0)}}, derivative=rate)
"""


STEERED = f"""{HEAD}
def rate(s, a, p):
    return {{"x": s.v * cos(s.psi), "y": s.v * sin(s.psi), "psi": s.v * sin(a.steer) / 0.3,
            "v": (a.speed - s.v) / 0.3}}

model = Model({{"x": "m", "y": "m", "psi": "rad", "v": "m/s"}}, {{"steer": "rad", "speed": "m/s"}},
              angles=("psi",), roles={{"position": ("x", "y"), "heading": "psi", "speed": "v"}},
              derivative=rate)
"""


def told(w, code: str) -> list[Finding]:
    """The findings of a proposal with this code."""
    return [one for one in Workspace(w.folder).propose().findings if one.code == code]


def reward_of(w) -> dict:
    return tomllib.loads((w.folder / "grounded.toml").read_text())["reward"]


def drawn(w, *words) -> None:
    assert grounded("-C", w.folder, "target", *words).code == 0


@pytest.fixture
def plane(tmp_path):
    """A planar drone that hovers at z = 1 m."""
    limits = "thrust = [0, 1]\nturn = [-3, 3]"
    return blank(tmp_path / "w", PLANE, limits=limits, start="{ z = 1, thrust = 0.4905 }")


def test_a_position_that_a_target_leaves_free_is_named(plane):
    edit(plane.folder, safety="z = [0.8, 1.2]")
    drawn(plane, "line", "--to", "x=2")
    proposed = Workspace(plane.folder).propose()
    assert proposed.candidate is None and proposed.standing.ending == "not allowed"
    drawn(plane, "line", "--to", "x=2", "--to", "z=1")
    assert Workspace(plane.folder).propose().candidate is not None


def test_a_target_says_what_it_leaves_free(plane):
    found = grounded("-C", plane.folder, "target", "line", "--to", "x=2", "--json").json
    assert found["free"] == ["z", "th", "vz"] and {*found["columns"]} == {"x", "vx"}
    edit(plane.folder, state="{ x = 2, z = 3 }")
    drawn(plane, "line", "--to", "x=2")
    refused = grounded("-C", plane.folder, "propose")
    assert refused.code == 1 and "weighs z" in refused.err


def test_weights_that_were_made_of_the_limits_seen_follow_those_that_are_given(tmp_path):
    (tmp_path / "cart.py").write_text(CART)
    t = np.arange(400) * 0.05
    rows = np.column_stack([t, np.sin(t), np.cos(t), np.sin(3 * t)])
    np.savetxt(tmp_path / "r.csv", rows, "%.5f", ",", header="t,x,v,force", comments="")
    begin(tmp_path / "w", tmp_path / "r.csv", model=tmp_path / "cart.py")
    w = Workspace(tmp_path / "w")
    for given, weight in (("", 0.01), ("[-20, 20]", 2.5e-5), ("[-2, 2]", 0.0025)):
        if given:
            edit(w.folder, limits=f"force = {given}")
            drawn(w, "step", "--to", "x=1", "--seconds", "2")
        assert reward_of(w)["input_change"]["force"] == pytest.approx(weight, rel=1e-3)
    edit(w.folder, input_change="{ force = 1 }", limits="force = [-20, 20]")
    drawn(w, "step", "--to", "x=1", "--seconds", "2")
    assert reward_of(w)["input_change"]["force"] == 1  # somebody chose it


@pytest.fixture
def ball(tmp_path):
    return blank(tmp_path / "w", BALL, dt=0.02)


LINE = ("line", "--to", "x=0.3", "--seconds", "2", "--hold", "0.5")


def test_rest_of_a_free_state_is_asked_for_at_the_end_only(ball):
    off = []
    for more in ((), ("--to", "th=0"), ("--rest",)):
        drawn(ball, *LINE, *more)
        run = Workspace(ball.folder).propose().candidate.predicted_states
        off.append(np.abs(run[:, 0] - Workspace(ball.folder).task.target[:, 0]).mean())
    reward = reward_of(ball)
    assert reward["terminal"].items() >= {"th": 1000, "w": 100}.items()
    assert reward["state"].keys() == {"x", "v"} < reward["terminal"].keys()
    assert reward["terminal"]["x"] == pytest.approx(10 * reward["state"]["x"], rel=1e-3)
    assert off[2] < 1.5 * off[0] + 1e-3 and off[1] > 1.4 * off[2]
    assert abs(run[-1, 2]) < 2e-3
    drawn(ball, *LINE)  # without it again, the weights at the end go with the columns
    assert reward_of(ball)["terminal"].keys() == {"x", "v"} == reward_of(ball)["state"].keys()
    assert grounded("-C", ball.folder, "target", "step", "--to", "x=1", "--rest").code == 2


def push(gain, slope=0.0, zone=0.0):
    """Return a model on a slope, whose throttle acts beyond a dead zone."""

    def dynamics(s, a, p):
        beyond = np.where(a.throttle > zone, a.throttle - zone, 0 * a.throttle)
        return {"x": s.v, "v": gain * beyond - slope - s.v}

    inputs = {"throttle": "1"}
    return Model(states={"x": "m", "v": "m/s"}, inputs=inputs, params={}, derivative=dynamics)


@pytest.mark.parametrize(
    ("model", "needs"),
    [
        (push(4.0, slope=1.2), True),
        (push(6.0, slope=1.2), True),  # a crude gain
        (push(0.0), True),  # a skeleton that is not fitted yet can't tell
        (push(4.0, zone=0.3), True),  # nor one that stands either way
        (push(4.0), False),  # its motors are off, or it would move
    ],
)
def test_a_held_input_holds_a_robot_unless_its_model_moves_less_without(model, needs):
    t = 0.02 * np.arange(600)
    v = np.where(t > 4, 0.3 * np.sin(t - 4), 0.0)
    sent = np.where(t > 4, 0.3 + 0.3 * np.sin(t - 4), 0.3)
    states = np.column_stack([np.cumsum(v) * 0.02, v])
    trial = Trial(states, sent[:-1, None], 0.02, model.state_names, model.input_names)
    stand = standstill(model, trial)
    assert stand is not None and stand.needs.tolist() == [needs] and stand.inputs == [0.3]


ASK = found("search.diagnose", then=NextCommand("diagnose"))


@pytest.fixture
def w(tmp_path):
    folder = make(tmp_path / "w").folder
    assert grounded("-C", folder, "learn", "--trials", "1").code == 0
    return Workspace(folder)


@pytest.fixture
def planned(monkeypatch):
    """Each planning of a next candidate, which takes a minute of CPU and finds none."""
    calls = []

    def propose(task, candidates, trials, options, *, identity, planner, tick):
        calls.append(identity)
        now = standing(task, candidates, trials, options, planner.fingerprint)
        return Proposal(ended(now, Ending.NO_STEP, ASK), None, is_new=False)

    monkeypatch.setattr(improve, "propose", propose)
    return calls


def test_an_end_is_planned_once_for_all_commands(w, planned):
    before = sorted(path.name for path in w.folder.rglob("*"))
    first, second, third = w.status(), w.status(), Workspace(w.folder).propose()
    assert planned == ["c0002"] and third.candidate is None
    for now in (second.standing, third.standing):
        assert now.to_json() == first.standing.to_json()
        assert now.findings == (ASK,)
    assert sorted(path.name for path in w.folder.rglob("*")) == before


def _safety(w):
    text = w.config.file.read_text()
    w.config.file.write_text(f"{text}\n[safety]\nv = [-50.0, 50.0]\n")


def _trial(w):
    assert grounded("-C", w.folder, "run", "best").code == 0
    (log,) = (w.folder / "runs").glob("c0001*")
    assert grounded("-C", w.folder, "ingest", log).code == 0


@pytest.mark.parametrize("change", [_safety, _trial])
def test_an_end_is_planned_again_after_a_change(w, planned, change):
    w.status()
    change(w)
    w.status()
    assert len(planned) == 2


@pytest.fixture
def doubtful(tmp_path):
    """A workspace whose c0002 lost by what may be bad luck: c0001 was handed out to run again."""
    w = make(tmp_path / "w")
    best, *_ = read_trial(run_candidate(w, propose_in(w).candidate.id).trial_file)
    ingest_log(w, w.folder / "runs" / "c0001-1.mcap")
    second = propose_in(w).candidate.id
    lost, *_ = read_trial(run_candidate(w, second).trial_file)
    cost = -w.task.utility(best)

    def worse(by):
        """Write a run of c0002 that lost by this share of the best cost; return its file."""
        low, high = 0.0, 1.0
        for _ in range(50):
            off = np.zeros_like(lost.states)
            off[1:, 0] = 0.5 * (low + high)
            run = replace(lost, states=lost.states + off)
            too_much = -w.task.utility(run) > (1 + by) * cost
            low, high = (low, off[1, 0]) if too_much else (off[1, 0], high)
        path = tmp_path / f"lost-{by}.mcap"
        write_trial(path, run, {"kind": "trial"})
        return path

    w.worse, w.best, w.unnamed = worse, best, tmp_path / "unnamed.mcap"
    ingest_log(w, worse(0.8), second)
    again = propose_in(w)
    assert again.candidate.id == "c0001" and not again.proposal.is_new
    return w


def test_a_run_that_costs_the_best_its_place_is_told_as_one_more_run_of_it(doubtful):
    states = doubtful.best.states.copy()
    states[1:, 0] += 5.0
    write_trial(doubtful.unnamed, replace(doubtful.best, states=states), {"kind": "trial"})
    found = ingest_log(doubtful, doubtful.unnamed, "c0001")
    assert (found.candidate, found.verdict) == ("c0001", "run again")
    assert standing_in(doubtful).incumbent.candidate.id == "c0002"
