"""A workspace from a model alone, and the robot's program that comes with it."""

import importlib.util
import re
import tomllib
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from cli import grounded
from facts import holding, holds
from grounded.errors import GroundedError
from grounded.policy import load
from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.store.trial_file import write_trial

ROOT = Path(__file__).resolve().parents[2]
MODEL = """
from grounded import Model, Param

def rate(s, a, p):
    return {"x": s.v, "v": (a.force - p.c * s.v) / p.M}

model = Model(name="sled", states={"x": "m", "v": "m/s"}, inputs={"force": "N"},
              params={"M": Param(1.0, "kg", 0.5, 2.0), "c": Param(0.3, "1", 0.0, 1.0)},
              derivative=rate)
"""


@pytest.fixture(autouse=True)
def installed(monkeypatch):
    """The entry points as pyproject.toml declares them, installed or not."""
    points = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]

    def found(group):
        return [EntryPoint(name, value, group) for name, value in points.get(group, {}).items()]

    monkeypatch.setattr("importlib.metadata.entry_points", found)


@pytest.fixture
def blank(tmp_path):
    (tmp_path / "sled.py").write_text(MODEL)
    return Workspace.create(tmp_path / "w", model=tmp_path / "sled.py")


def limited(workspace):
    """State a limit of the input, without which nothing is handed to a robot."""
    config = workspace.folder / "grounded.toml"
    text, stated = config.read_text(), "force = [-50.0, 50.0]"
    config.write_text(re.sub(r"(?m)^(\[limits\].*)$", rf"\1\n{stated}", text))
    workspace.forget()
    return workspace


def driver(folder):
    spec = importlib.util.spec_from_file_location("drive", folder / "drive.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_blank_workspace_goes_from_a_model_to_an_accepted_trial(blank, tmp_path, monkeypatch):
    proposed = limited(blank).propose()
    drive = driver(blank.folder)
    state, sent = np.array([0.0, 0.0]), []  # target.csv says where it starts
    monkeypatch.setattr(drive.time, "sleep", lambda seconds: None)

    def send(u):
        sent.append(float(u[0]))
        state[:] += 0.05 * np.array([state[1], u[0] - 0.5 * state[1]])

    monkeypatch.setattr(drive, "measure", lambda: state.copy())
    monkeypatch.setattr(drive, "send", send)
    drive.main(str(proposed.file), str(tmp_path / "run.mcap"))
    assert len(sent) == 101
    taken = blank.ingest(tmp_path / "run.mcap")
    assert taken.candidate == "c0001"
    assert blank.status().standing.incumbent.candidate.id == "c0001"


def test_the_first_plan_says_what_the_task_leaves_open(blank):
    """A target for one state was refused by what the template weighs; no limit was no word."""
    blank.target({"x": np.linspace(0, 1, 41)})
    folder = blank.folder
    text = (folder / "grounded.toml").read_text().replace("horizon = 40", "horizon = 30")
    (folder / "grounded.toml").write_text(text)
    notes = blank.propose().proposal.notes
    assert [("force" in one, "41 rows" in one) for one in notes[-2:]] == [(1, 0), (0, 1)]
    limits = text.replace("[limits]", "[limits]\nforce = [-2, 2]").replace("= 30", "= 40")
    (folder / "grounded.toml").write_text(limits)
    assert not [one for one in blank.propose().proposal.notes if "[limits] has none" in one]


def rewarded(w):
    return tomllib.loads((w.folder / "grounded.toml").read_text())["reward"]


def test_a_target_renews_the_weight_on_changes_that_limits_give(blank):
    """0.01 belongs to an input from -1 to 1: in degrees it is 2000 times too heavy."""
    config = blank.folder / "grounded.toml"
    assert rewarded(blank)["input_change"] == {"force": 0.01}
    blank.target({"x": np.linspace(0, 1, 41)})
    assert rewarded(blank)["input_change"] == {"force": 0.01}  # no limits
    limited = config.read_text().replace("[limits]", "[limits]\nforce = [-45, 45]")
    config.write_text(limited)
    told = grounded("-C", blank.folder, "target", "step", "--to", "x=1", "--seconds", "2").out
    assert holds(told, "input_change", "4.938e-06")
    assert rewarded(blank)["input_change"] == {"force": 4.938e-06}
    assert blank.task.reward.input_change[0] == 4.938e-06
    again = grounded("-C", blank.folder, "target", "step", "--to", "x=2", "--seconds", "2").out
    assert "input_change" not in again


@pytest.mark.parametrize(
    "chosen", ["input_change = { force = 0.02 }", "state = { x = 3.0, v = 1.0 }"]
)
def test_a_weight_that_somebody_chose_stays(blank, chosen):
    config = blank.folder / "grounded.toml"
    key = chosen.split(" = ")[0]
    text = re.sub(rf"(?m)^{key} = .*$", chosen, config.read_text())
    config.write_text(text.replace("[limits]", "[limits]\nforce = [-45, 45]"))
    before = rewarded(blank)["input_change"]
    blank.target({"x": np.linspace(0, 1, 41)})
    assert rewarded(blank)["input_change"] == before


def test_a_plan_that_stays_far_from_where_its_target_ends_is_told(blank):
    """Inputs were so dear that it got 0.03 m of 0.1 m; nothing was at a limit, nothing said."""
    config, way = blank.folder / "grounded.toml", np.linspace(0, 1, 41)
    config.write_text(config.read_text().replace("[limits]", "[limits]\nforce = [-50, 50]"))
    blank.target({"x": way**2 * (3 - 2 * way)})
    told = blank.propose().proposal.notes
    assert not [one for one in told if "the plan ends" in one]
    dear = "input_change = { force = 2000 }"
    config.write_text(re.sub(r"(?m)^input_change = .*$", dear, config.read_text()))
    (note,) = (one for one in blank.propose().proposal.notes if "the plan ends" in one)
    assert holds(note, "x", "1,000 mm", "[reward]")


@pytest.mark.parametrize(("noise", "told"), [(1e-5, False), (0.3, True)])
def test_gains_that_shake_an_input_by_the_sensors_noise_are_told(blank, tmp_path, noise, told):
    config, way = blank.folder / "grounded.toml", np.linspace(0, 1, 41)
    config.write_text(config.read_text().replace("[limits]", "[limits]\nforce = [-8, 8]"))
    blank.target({"x": way**2 * (3 - 2 * way)})
    rng, t = np.random.default_rng(0), 0.05 * np.arange(101)
    states = np.stack([np.sin(t), np.cos(t) + noise * rng.standard_normal(101)], axis=1)
    inputs = -np.sin(t[:-1, None]) + 0.3 * np.cos(t[:-1, None])
    trial = Trial(states, inputs, 0.05, ("x", "v"), ("force",))
    write_trial(tmp_path / "hand.mcap", trial, {"kind": "data"})
    blank.ingest(tmp_path / "hand.mcap", data=True)
    notes = [one for one in blank.propose().proposal.notes if "noise" in one]
    assert len(notes) == told
    assert all(holds(one, "force", "N rms", "v (0.", "input_change") for one in notes)


def test_a_target_that_nobody_has_drawn_is_told(blank):
    blank.target({"x": np.zeros(41), "v": np.zeros(41)})
    assert any("`target`" in one for one in blank.propose().proposal.notes)
    blank.target({"x": np.linspace(0, 1, 41)})
    assert not any("`target`" in one for one in blank.propose().proposal.notes)


HOVER = """from grounded import Model, Param

def rate(s, a, p):
    lift = p.k * (a.left * a.left + a.right * a.right) / p.m
    return {"z": s.v, "v": lift - 9.81, "w": a.left - a.right}

model = Model(states={"z": "m", "v": "m/s", "w": "rad/s"}, inputs={"left": "1", "right": "1"},
              params={"k": Param(8.0, "N"), "m": Param(1.2, "kg")}, derivative=rate)
"""


@pytest.mark.slow
def test_what_holds_the_start_is_held_before_it_or_asked_for(tmp_path):
    """A quadrotor was planned from a thrust of 0, and dipped; after its end 0 was sent again."""
    (tmp_path / "quad.py").write_text(HOVER)
    told = grounded("init", tmp_path / "w", "--blank", "--model", tmp_path / "quad.py").out
    w = Workspace(tmp_path / "w")
    hover = (1.2 * 9.81 / 16) ** 0.5
    assert list(w.config.task.start) == ["left", "right"] and "left = 0.8577" in told
    np.testing.assert_allclose(w.task.past, hover, rtol=1e-5)
    file = w.folder / "grounded.toml"
    whole = file.read_text()
    given = next(row for row in whole.splitlines() if row.startswith("start = "))

    def notes(start, limits="[limits]"):
        file.write_text(whole.replace(given, f"start = {start}").replace("[limits]", limits))
        w.forget()
        return [n for n in w.propose().proposal.notes if "the plan assumes" in n]

    (note,) = notes("{ }")
    assert "v changes" in note and "left = 0.8578, right = 0.8578" in note
    assert not notes("{ }", "[limits]\nleft = [0, 0.8]")  # inside which nothing holds it
    assert not notes("{ left = 0.0 }")  # somebody says so
    assert not notes("{ v = 1.0 }")  # in motion, which no input holds


BALL = """
import numpy as np
from grounded import Model

def rate(s, a, p):
    return {"x": s.v, "v": 7.0 * np.sin(s.beam) + 0.07, "beam": (a.servo - s.beam) / 0.1}

model = Model(states={"x": "m", "v": "m/s", "beam": "rad"}, inputs={"servo": "rad"},
              derivative=rate)
"""


def test_how_a_start_moves_is_told_of_the_robot_not_of_a_filter(tmp_path):
    """A speed's filter hid a beam that is not level: 0.00566 instead of 0.056 m/s^2."""
    (tmp_path / "ball.py").write_text(BALL)
    w = Workspace.create(tmp_path / "w", model=tmp_path / "ball.py", dt=0.02)
    w.target({"x": np.linspace(0.0, 0.3, 101)})
    file = w.folder / "grounded.toml"
    lag = '[[model.effects]]\nname = "sensor_lag:v"\ntau = 0.1\n'
    file.write_text(file.read_text() + lag)
    notes = Workspace(w.folder).propose().proposal.notes
    (note,) = [one for one in notes if "the plan assumes" in one]
    assert "v changes at once, by 0.07 m/s^2" in note


FAN = """
from grounded import Model, Param

def rate(s, a, p):
    return {"h": s.v, "v": 9.81 * (s.fan / 2700 - 1) - 2 * s.v, "fan": (56 * a.pwm - s.fan) / p.lag}

model = Model(states={"h": "m", "v": "m/s", "fan": "rpm"}, inputs={"pwm": "%"},
              params={"lag": Param(0.3, "s")}, derivative=rate)
"""


def test_a_start_that_another_state_would_hold_is_told_with_it(tmp_path):
    """The advice was to widen [safety]: the fan of a ball in a tube stood still at the start."""
    (tmp_path / "fan.py").write_text(FAN)
    w = Workspace.create(tmp_path / "w", model=tmp_path / "fan.py")
    w.target({"h": np.linspace(0.2, 0.6, 101)})
    file = w.folder / "grounded.toml"
    limits = "[safety]\nh = [0.15, 0.9]\n[limits]\npwm = [0, 100]"
    file.write_text(file.read_text().replace("[limits]", limits))
    proposed = Workspace(w.folder).propose()
    assert proposed.standing.ending == "not allowed" and proposed.then.verb == "propose"
    (note,) = (n for n in proposed.proposal.notes if "the plan assumes" in n)
    assert "fan = 2700, pwm = 48.21" in note and "v changes" in note
    assert not any("widen" in n for n in proposed.proposal.notes)
    text = re.sub(
        r"(?m)^start = .*$", "start = { h = 0.2, fan = 2700, pwm = 48.21 }", file.read_text()
    )
    file.write_text(text)
    assert Workspace(w.folder).propose().candidate is not None
    heavier = 'effects = [{name = "offset:v", c = -0.981}]\n[task]'  # a tenth more to carry
    given = "start = { h = 0.2 }"
    file.write_text(re.sub(r"(?m)^start = .*$", given, text.replace("[task]", heavier)))
    (note,) = (n for n in Workspace(w.folder).propose().proposal.notes if "the plan assumes" in n)
    assert "fan = 2970, pwm = 53.04" in note


TILT = """
from grounded import Model, Param

def rate(s, a, p):
    return {"q": s.w, "w": 2 * a.u - p.g, "y": s.r, "r": 3 * a.v - 4 * s.r - 0.01 * a.u}

model = Model(states={"q": "rad", "w": "rad/s", "y": "rad", "r": "rad/s"},
              inputs={"u": "V", "v": "V"}, params={"g": Param(GRAVITY, "rad/s^2")}, derivative=rate)
"""


@pytest.mark.parametrize(("gravity", "told"), [(0.002, False), (2.0, True)])
def test_an_input_that_hardly_moves_the_start_is_not_asked_for(tmp_path, gravity, told):
    """`next: propose` after `propose`, for 0.001 rad/s^2 and the edge of a dead zone."""
    (tmp_path / "tilt.py").write_text(TILT.replace("GRAVITY", str(gravity)))
    w = Workspace.create(tmp_path / "w", model=tmp_path / "tilt.py")
    way = 0.3 * np.linspace(0, 1, 51)
    w.target({"q": way, "y": way})
    file = w.folder / "grounded.toml"
    adopted = 'effects = [{name = "dead_zone:v", c = 1.5}]\n[task]'
    text = file.read_text().replace("[limits]", "[limits]\nu = [-24, 24]\nv = [-24, 24]")
    text = re.sub(r"(?m)^start = .*$", "start = { }", text)
    file.write_text(text.replace("[task]", adopted, 1))
    proposed = Workspace(w.folder).propose()
    notes = [n for n in proposed.proposal.notes if "the plan assumes" in n]
    assert bool(notes) == told and all("u = 1, v = 0" in n for n in notes)


def test_a_friction_too_steep_for_a_step_is_followed_by_a_plan(blank):
    """A width of 0.06 % of the fastest speed: a ball was planned to 4 m instead of 0.6, or not."""
    file, way = blank.folder / "grounded.toml", np.linspace(0, 1, 41)
    blank.target({"x": 0.2 * way**2 * (3 - 2 * way)})
    steep = 'effects = [{name = "coulomb_friction:v", c = 0.25, width = 1e-5}]\n[task]'
    plain = steep.replace("1e-5", "0.01")
    text, found = file.read_text(), []
    for effects in (plain, steep):
        file.write_text(text.replace("[task]", effects, 1))
        candidate = Workspace(blank.folder).propose().candidate
        found.append(candidate.predicted_utility)
        assert candidate.predicted_states[-1, 0] == pytest.approx(0.2, abs=0.05)
    assert found[1] == pytest.approx(found[0], rel=0.1, abs=0.01)


def test_a_model_that_stands_without_input_needs_none(blank):
    assert not blank.config.task.start and not blank.task.past.any()


def test_a_target_is_read_once(blank, monkeypatch):
    reads, read = [], blank.read_target.__wrapped__
    monkeypatch.setattr(blank, "read_target", cache(lambda path: reads.append(path) or read(path)))
    blank.propose()
    assert len(reads) == 1 and blank.origin.horizon == blank.task.horizon
    assert len(reads) == 1


def test_a_workspace_in_a_folder_of_this_one_is_named(blank):
    done = grounded("-C", blank.folder.parent, "status")
    assert done.code == 1 and f"-C {blank.folder}" in done.err


def test_what_is_missing_in_the_robots_program_is_named(blank):
    with pytest.raises(NotImplementedError, match="measure"):
        driver(blank.folder).measure()


def test_a_candidate_as_proposed_runs_like_its_export(blank, tmp_path):
    candidate = limited(blank).propose()
    as_proposed = load(candidate.file, states=("x", "v"), inputs=("force",))
    as_exported = load(blank.export("c0001", tmp_path / "c0001.npz").file)
    for t, s in ((0.0, [1.0, 0.2]), (0.05, [0.9, 0.1]), (99.0, [0.0, 0.0])):
        np.testing.assert_array_equal(as_proposed.action(t, s), as_exported.action(t, s))
    with pytest.raises(GroundedError, match=holding("('x', 'v')", "('v', 'x')")):
        load(candidate.file, states=("v", "x"))
    with pytest.raises(GroundedError, match=holding("0" * 16)):
        load(candidate.file, task="0" * 16)


def test_a_candidate_is_not_read_where_nothing_reads_it(blank, monkeypatch):
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [])
    with pytest.raises(GroundedError, match="npz"):
        load(blank.propose().file)


def test_nothing_is_overwritten(blank, tmp_path):
    before = (blank.folder / "drive.py").read_bytes()
    with pytest.raises(GroundedError, match="exists already"):
        Workspace.create(blank.folder, model=tmp_path / "sled.py")
    assert (blank.folder / "drive.py").read_bytes() == before


def test_a_blank_workspace_takes_the_control_interval(tmp_path):
    (tmp_path / "sled.py").write_text(MODEL)
    made = Workspace.create(tmp_path / "w", model=tmp_path / "sled.py", dt=0.02)
    assert tomllib.loads((made.folder / "grounded.toml").read_text())["task"]["dt"] == 0.02
    assert made.propose().candidate.policy.dt == 0.02


def test_a_model_that_needs_its_neighbours_leaves_nothing_behind(tmp_path):
    (tmp_path / "masses.csv").write_text("1.0\n")
    (tmp_path / "sled.py").write_text(
        "from pathlib import Path\n(Path(__file__).parent / 'masses.csv').read_text()\n" + MODEL
    )
    with pytest.raises(GroundedError) as refused:
        Workspace.create(tmp_path / "w", model=tmp_path / "sled.py")
    assert "masses.csv" in str(refused.value) and str(tmp_path / "w") in str(refused.value)
    assert not (tmp_path / "w").exists()
    (tmp_path / "w").mkdir()
    (tmp_path / "w" / "masses.csv").write_text("1.0\n")
    (tmp_path / "w" / "model.py").write_text((tmp_path / "sled.py").read_text())
    made = Workspace.create(tmp_path / "w", model=tmp_path / "w" / "model.py")
    assert (made.folder / "drive.py").is_file()


def test_a_plan_whose_inputs_cost_nearly_all_says_so_and_a_target_tells_its_weights(blank):
    """A stranger's figure-8 stayed 3 cm off: 93 % of its cost was the drive's effort."""
    done = grounded("-C", blank.folder, "target", "step", "--to", "x=1")
    assert holds(done.out, "[reward] state", "x = 1")
    stays = grounded("-C", blank.folder, "target", "step", "--to", "x=0")
    assert holds(stays.err, "x stays", "[reward] state")
    grounded("-C", blank.folder, "target", "step", "--to", "x=1")
    file = blank.folder / "grounded.toml"
    text = file.read_text()
    assert "input = { }" in text
    assert not [n for n in blank.propose().proposal.notes if "of the plan's cost" in n]
    s = np.linspace(0, 1, 201)
    blank.target({"x": 10 * s**3 * (10 - 15 * s + 6 * s**2)})
    text, told = file.read_text(), []
    for x, force in ((1.0, 1.0), (1000.0, 0.1)):  # 3 % and 0.03 % of the way off
        weighed = text.replace("state = {x = 0.01}", f"state = {{x = {x}}}")
        file.write_text(weighed.replace("input = { }", f"input = {{ force = {force} }}"))
        notes = Workspace(blank.folder).propose().proposal.notes
        told.append(any("of the plan's cost" in note for note in notes))
    assert told == [True, False]
