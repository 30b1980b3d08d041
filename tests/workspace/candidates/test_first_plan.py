"""What the first plan of a task tells: what holds its start, and what its target leaves free."""

import re
import tomllib

import numpy as np
import pytest

from cli import grounded
from facts import holds
from grounded_trials import Workspace
from grounded_trials.starting.begin import begin
from grounded_trials.workspace.candidates import rest_at_end
from grounded_trials.workspace.candidates.at_rest import rest_value
from grounded_trials.workspace.candidates.first_plan import in_another_unit
from grounded_trials.workspace.folder import Folder
from workspaces import make

DRY = '{name = "coulomb_friction:v", c = 0.04, width = 0.001}'
LIFTED = """
from grounded import Model, Param

def rate(s, a, p):
    return {"h": s.v, "v": p.k * a.thrust - 9.81, "q": a.turn - s.q}

model = Model(states={"h": "m", "v": "m/s", "q": "deg/s"}, inputs={"thrust": "1", "turn": "deg/s"},
              params={"k": Param(20.0, "m/s^2")}, derivative=rate)
"""


def test_what_holds_the_start_is_told_of_an_adopted_model_with_all_that_is_given(tmp_path):
    """An effect that fades with time never rests; what was given is to stay in the line told."""
    (tmp_path / "lifted.py").write_text(LIFTED)
    w = Workspace.create(tmp_path / "w", model=tmp_path / "lifted.py")
    w.target({"h": np.linspace(1.0, 1.5, 101)})
    file = w.folder / "grounded.toml"
    limits = "[limits]\nthrust = [0.1, 1]\nturn = [-200, 200]"
    text = file.read_text().replace("[limits]", limits)

    def told(effects: str, start: str) -> str:
        changed = re.sub(r"(?m)^start = .*$", f"start = {{ {start} }}", text)
        file.write_text(changed.replace("[task]", f"effects = [{effects}]\n[task]", 1))
        notes = [n for n in Workspace(w.folder).propose().proposal.notes if "the plan assumes" in n]
        return " ".join(notes).partition("start = ")[2]

    fading = '{name = "input_fade:thrust", k = 0.001}'
    dead = '{name = "dead_zone:thrust", c = 0.2}'
    assert told(fading, "h = 1") == "{ h = 1, thrust = 0.4905, turn = 0 }"
    assert told(dead, "h = 1") == "{ h = 1, thrust = 0.6905, turn = 0 }"
    given = "h = 1, thrust = 0.4905, turn = 0"
    assert told("", given) == ""
    # the model that was planned with is another now, and what held it then holds no longer
    assert told(dead, given) == "{ h = 1, thrust = 0.6905, turn = 0 }"
    assert told(dead, given) == ""  # once


BALANCED = """
from grounded import Model

def rate(s, a, p):
    return {"x": s.v, "th": s.w, "v": a.u, "w": 10 * s.th - a.u}

model = Model(states={"x": "m", "th": "rad", "v": "m/s", "w": "rad/s"}, inputs={"u": "m/s^2"},
              derivative=rate)
"""


def test_a_start_that_a_target_gives_is_told_for_each_target_where_its_sensor_has_a_bias(tmp_path):
    """It was told of the first target; of the next, drawn from th = 0 as well, no more."""
    (tmp_path / "mine.py").write_text(BALANCED)
    w = Workspace.create(tmp_path / "w", model=tmp_path / "mine.py")
    file = w.folder / "grounded.toml"
    text = file.read_text().replace("[limits]", "[limits]\nu = [-3, 3]")
    bias = 'effects = [{name = "sensor_bias:th", b = 0.0174}]\n[task]'
    text = re.sub(r"(?m)^start = .*$", "start = { }", text).replace("[task]", bias, 1)
    file.write_text(text)

    def told() -> str:
        notes = [n for n in Workspace(w.folder).propose().proposal.notes if "the plan assumes" in n]
        return " ".join(notes).partition("start = ")[2]

    for far in (0.1, 0.2):
        to = {"x": np.linspace(0, far, 41), **{name: np.zeros(41) for name in ("th", "v", "w")}}
        Workspace(w.folder).target(to)
        assert told() == "{ th = 0.0174, u = 0 }"
        assert told() == ""  # once
    file.write_text(file.read_text().replace("start = { }", "start = { th = 0.0174, u = 0 }"))
    assert told() == ""


@pytest.mark.parametrize(
    ("effects", "shown"),
    [
        ("", 0.0),
        ('{name = "offset:v", c = 0.1214}', -0.1214 / 7.0),
        ('{name = "sensor_bias:beam", b = -0.0173}', -0.0173),
        (f'{{name = "offset:v", c = 0.1214}}, {DRY}', -0.1214 / 7.0),
        ('{name = "offset:v", c = 0.1214}, {name = "sensor_lag:v", tau = 0.06}', -0.1214 / 7.0),
    ],
)
def test_a_free_state_rests_where_the_adopted_effects_let_it(tmp_path, effects, shown):
    """A ball was to stop on a beam at 0 rad, which the adopted offset says is not level."""
    ball = BALANCED.replace("a.u,", "7.0 * s.beam,").replace("10 * s.th - a.u", "8 * (a.u - s.w)")
    (tmp_path / "mine.py").write_text(ball.replace('"th"', '"beam"'))
    w = Workspace.create(tmp_path / "w", model=tmp_path / "mine.py")
    file = w.folder / "grounded.toml"
    file.write_text(file.read_text().replace("[task]", f"effects = [{effects}]\n[task]", 1))
    found = rest_value(Folder(w.folder), {"x": 0.15}, "beam")
    assert found == pytest.approx(shown, abs=2e-4)


def test_an_arm_that_its_friction_holds_needs_no_input_before_the_start(tmp_path):
    """A rotary pendulum, pulled by its cable with 0.05 V and held by 0.28 V, was said to move."""
    hanging = BALANCED.replace("10 * s.th", "-10 * s.th").replace('"m', '"rad')
    (tmp_path / "mine.py").write_text(hanging)
    w = Workspace.create(tmp_path / "w", model=tmp_path / "mine.py")
    file = w.folder / "grounded.toml"
    text = file.read_text().replace("[limits]", "[limits]\nu = [-3, 3]")
    text = re.sub(r"(?m)^start = .*$", "start = { }", text)
    spring = '{name = "joint_spring:u<-x", k = 0.5, b = -0.25}'

    def told(*effects: str) -> str:
        file.write_text(text.replace("[task]", f"effects = [{', '.join(effects)}]\n[task]", 1))
        to = {"x": np.linspace(0, 0.4, 41), **{name: np.zeros(41) for name in ("th", "v", "w")}}
        Workspace(w.folder).target(to)
        notes = [n for n in Workspace(w.folder).propose().proposal.notes if "the plan assumes" in n]
        return " ".join(notes).partition("start = ")[2]

    assert told(spring) == "{ u = -0.25 }"
    assert told(spring, '{name = "joint_friction:u<-v", c = 0.3, b = 0.0, width = 0.005}') == ""


def test_a_plan_that_begins_from_no_input_is_not_handed_out_before_it_was_said(tmp_path):
    """A helicopter's `next:` was to export a plan from 0 V, which a note said to mend first."""
    (tmp_path / "lifted.py").write_text(LIFTED)
    w = Workspace.create(tmp_path / "w", model=tmp_path / "lifted.py")
    w.target({"h": np.linspace(1.0, 1.5, 101)})
    file = w.folder / "grounded.toml"
    text = file.read_text().replace("[limits]", "[limits]\nthrust = [0, 1]\nturn = [-9, 9]")
    text = re.sub(r"(?ms)^\[system\].*?(?=^\[|\Z)", "", text)
    file.write_text(re.sub(r"(?m)^start = .*$", "start = { h = 1 }", text))
    first = Workspace(w.folder).propose()
    assert "the plan assumes" in " ".join(first.proposal.notes) and first.then.verb == "propose"
    again = Workspace(w.folder).propose()  # it is right as it is
    assert again.candidate.id == first.candidate.id and again.then.verb == "export"


def test_what_held_a_robot_as_its_log_began_is_written(tmp_path):
    """A helicopter's log began with 2 s of hover at 7.96 V, and its plans with 0 V."""
    (tmp_path / "lifted.py").write_text(LIFTED)
    t = np.arange(0, 10, 0.02)
    thrust = np.where(t < 2, 0.4905, 0.4905 + 0.2 * np.sin(2 * t))
    v = np.where(t < 2, 0, 0.5 * np.sin(t))

    def start(h, v, thrust):
        rows = np.column_stack([t, h, v, 0 * t, thrust, np.where(t < 2, 0, np.sin(t))])
        names = "t,h,v,q,thrust,turn"
        np.savetxt(tmp_path / "log.csv", rows, "%.6f", ",", header=names, comments="")
        folder = tmp_path / f"w{len(list(tmp_path.iterdir()))}"
        begin(folder, tmp_path / "log.csv", model=tmp_path / "lifted.py")
        return tomllib.loads((folder / "grounded.toml").read_text())["task"]["start"]

    noise = 1e-3 * np.random.default_rng(0).standard_normal(len(t))
    rising = np.cumsum(v) * 0.02
    assert start(rising + noise, v + noise, thrust) == {"thrust": 0.4905, "turn": 0.0}
    high = start(5 + rising, v, thrust)
    assert high == {"h": 5.0, "thrust": 0.4905, "turn": 0.0}
    assert start(rising, v + 0.4, thrust) == {}  # it flies on
    assert start(rising, v, thrust + 0.2 * np.sin(t)) == {}
    assert start(rising, v, thrust - 0.4905) == {}  # nothing has to hold it
    assert start(rising, v, thrust - 0.4905 + noise) == {}


def test_what_holds_a_robot_is_what_its_controller_ended_at(tmp_path):
    """An arm held by a PD controller sagged at first: its start was { }."""
    (tmp_path / "link.py").write_text(LINK)
    t = np.arange(0, 10, 0.01)
    moves = np.where(t < 1, 0, np.sin(t - 1))
    sag = 0.02 * (1 - np.exp(-np.minimum(t, 1) / 0.06))
    q, w = 0.4 + sag + moves, np.gradient(sag + moves, 0.01)
    tau = 4.0 + 40 * sag + 6 * moves + 0.02 * np.random.default_rng(1).standard_normal(len(t))
    rows = np.column_stack([t, q, w, tau])
    np.savetxt(tmp_path / "log.csv", rows, "%.6f", ",", header="t,q,w,tau", comments="")
    begin(tmp_path / "w", tmp_path / "log.csv", model=tmp_path / "link.py")
    start = tomllib.loads((tmp_path / "w/grounded.toml").read_text())["task"]["start"]
    assert start == {"q": pytest.approx(0.42, abs=1e-3), "tau": pytest.approx(4.8, abs=0.02)}


LINK = """
import numpy as np
from grounded import Model

def rate(s, a, p):
    return {"q": s.w, "w": 4.0 * (a.tau - 5.0 * np.cos(s.q))}

model = Model(states={"q": "rad", "w": "rad/s"}, inputs={"tau": "N m"}, params={}, derivative=rate)
"""


def test_what_holds_a_joint_is_told_though_it_sticks(tmp_path):
    """With an adopted friction nothing was said, and the elbow beside it began with a drop."""
    (tmp_path / "link.py").write_text(LINK)
    w = Workspace.create(tmp_path / "w", model=tmp_path / "link.py")
    w.target({"q": np.linspace(0.3, 0.8, 101)})
    file = w.folder / "grounded.toml"
    friction = '{name = "joint_friction:tau<-w", c = 0.9, b = 0.35, width = 0.004}'
    text = file.read_text().replace("[limits]", "[limits]\ntau = [-20, 20]")
    text = re.sub(r"(?m)^start = .*$", "start = { q = 0.3 }", text)
    for effects in ("", friction):
        file.write_text(text.replace("[task]", f"effects = [{effects}]\n[task]", 1))
        notes = Workspace(w.folder).propose().proposal.notes
        (note,) = [note for note in notes if "the plan assumes" in note]
        assert f"tau = {5 * np.cos(0.3):.4g}" in note.partition("start = ")[2]


PLANE = """
from math import sin, cos
from grounded import Model, Param

def rate(s, a, p):
    up, aside = p.k * a.thrust * cos(s.th), p.k * a.thrust * sin(s.th)
    return {"x": s.vx, "z": s.vz, "th": a.turn, "vx": aside, "vz": up - 9.81}

model = Model(states={"x": "m", "z": "m", "th": "rad", "vx": "m/s", "vz": "m/s"},
              inputs={"thrust": "1", "turn": "rad/s"}, params={"k": Param(20.0, "m/s^2")},
              derivative=rate)
"""


def test_a_position_that_a_target_leaves_free_is_named_with_the_target_that_holds_it(tmp_path):
    """It rose to 24 m, and the advice was to widen [safety]."""
    (tmp_path / "plane.py").write_text(PLANE)
    folder = tmp_path / "w"
    Workspace.create(folder, model=tmp_path / "plane.py")
    file = folder / "grounded.toml"
    tables = "[safety]\nz = [0.8, 1.2]\n[limits]\nthrust = [0, 1]\nturn = [-3, 3]"
    text = file.read_text().replace("[limits]", tables)
    file.write_text(re.sub(r"(?m)^start = .*$", "start = { z = 1, thrust = 0.4905 }", text))

    def asked():
        return [n for n in Workspace(folder).propose().proposal.notes if "leaves [safety]" in n]

    assert grounded("-C", folder, "target", "line", "--to", "x=2").code == 0
    (note,) = asked()
    assert "widen" not in note
    (command,) = re.findall("`grounded (.*)`", note)
    assert command.endswith("target line --to x=2 --to z=1")
    assert grounded(*command.split()).code == 0 and not asked()
    assert Workspace(folder).propose().candidate is not None
    weights = re.sub(r"(?m)^state = .*$", "state = { x = 2.0 }", file.read_text())
    file.write_text(weights)
    (note,) = asked()
    assert holds(note, "z leaves", "[reward] state") and "target line" not in note


CART = """
from grounded import Model, Param

def rate(s, a, p):
    return {"x": s.v, "v": (a.force - 0.3 * s.v) / p.M}

model = Model(states={"x": "m", "v": "m/s"}, inputs={"force": "N"},
              params={"M": Param(1.0, "kg", 0.5, 2.0)}, derivative=rate)
"""


def test_init_names_the_files_to_read_where_they_are(tmp_path):
    """It said `read w/model.py and grounded.toml`."""
    (tmp_path / "cart.py").write_text(CART)
    t = np.arange(100) * 0.05
    rows = np.column_stack([t, np.sin(t), np.cos(t), np.sin(3 * t)])
    np.savetxt(tmp_path / "r.csv", rows, "%.5f", ",", header="t,x,v,force", comments="")
    made = ("init", tmp_path / "w", "--from", tmp_path / "r.csv", "--model", tmp_path / "cart.py")
    told = grounded(*made).out.split()
    for name in ("model.py", "grounded.toml"):
        assert str(tmp_path / "w" / name) in [word.rstrip(";") for word in told]


def test_weights_that_were_made_of_the_limits_seen_follow_those_that_are_given(tmp_path):
    """They stayed as the log's narrow range had made them: 700 times too heavy."""
    (tmp_path / "cart.py").write_text(CART)
    t = np.arange(400) * 0.05
    rows = np.column_stack([t, np.sin(t), np.cos(t), np.sin(3 * t)])
    np.savetxt(tmp_path / "r.csv", rows, "%.5f", ",", header="t,x,v,force", comments="")
    folder = tmp_path / "w"
    begin(folder, tmp_path / "r.csv", model=tmp_path / "cart.py")
    file = folder / "grounded.toml"
    step = ("-C", folder, "target", "step", "--seconds", "2", "--to")

    def weight() -> float:
        return tomllib.loads(file.read_text())["reward"]["input_change"]["force"]

    def limited(low: float, high: float) -> list[str]:
        given = f"[limits]\nforce = [{low}, {high}]\n"
        file.write_text(re.sub(r"(?ms)^\[limits\].*?\n(?=\n)", given, file.read_text()))
        notes = Workspace(folder).propose().proposal.notes
        return [note for note in notes if "input_change" in note and "[limits]" in note]

    (note,) = [n for n in Workspace(folder).propose().proposal.notes if "range used" in n]
    assert holds(note, "r.csv", "[limits]", "`target`")
    assert weight() == pytest.approx(0.01, rel=1e-3) and not limited(-1, 1)
    assert not any("range used" in n for n in Workspace(folder).propose().proposal.notes)
    (note,) = limited(-20, 20)
    assert "force = 2.5e-05" in note
    assert grounded(*step, "x=1").code == 0
    assert weight() == 2.5e-05 and not limited(-20, 20)
    assert limited(-2, 2) and grounded(*step, "x=2").code == 0
    assert weight() == 0.0025
    file.write_text(
        re.sub(r"(?m)^input_change = .*$", "input_change = { force = 1 }", file.read_text())
    )
    assert not limited(-20, 20) and grounded(*step, "x=1").code == 0
    assert weight() == 1


def planar(tmp_path, tables="[limits]"):
    """A workspace of a planar drone whose target goes to x = 2 m, with further tables."""
    (tmp_path / "plane.py").write_text(PLANE)
    folder = tmp_path / "w"
    Workspace.create(folder, model=tmp_path / "plane.py")
    file = folder / "grounded.toml"
    text = file.read_text().replace("[limits]", f"{tables}\nthrust = [0, 1]\nturn = [-3, 3]")
    file.write_text(re.sub(r"(?m)^start = .*$", "start = { z = 1, thrust = 0.4905 }", text))
    return folder, file


def test_where_a_track_ends_another_target_is_advised_first(tmp_path):
    """The advice was to widen [safety]: the ends of a real track, beyond which a crane stops."""
    folder, _ = planar(tmp_path, "[safety]\nx = [-0.5, 0.5]\n[limits]")
    assert grounded("-C", folder, "target", "line", "--to", "x=2", "--to", "z=1").code == 0
    (note,) = [n for n in Workspace(folder).propose().proposal.notes if "nothing was run yet" in n]
    assert 0 < note.index("draw a target") < note.index("widen [safety] only")


def test_of_weights_by_other_limits_nobody_is_said_to_have_made_them(tmp_path):
    """`target` had written them by [limits]; they were said to be `init`'s, of a log's range."""
    folder, file = planar(tmp_path)
    text = file.read_text()
    made = re.search(r"(?m)^input_change = .*$", text)[0]
    file.write_text(text.replace(made, f"# {made}\n{made}"))
    assert grounded("-C", folder, "target", "line", "--to", "x=2", "--to", "z=1").code == 0
    weights = tomllib.loads(file.read_text())["reward"]["input_change"]
    assert weights["thrust"] == pytest.approx(0.04)
    assert not [n for n in Workspace(folder).propose().proposal.notes if "input_change has" in n]
    file.write_text(file.read_text().replace("thrust = [0, 1]", "thrust = [0.3, 0.7]"))
    notes = Workspace(folder).propose().proposal.notes
    (note,) = [n for n in notes if "input_change has" in n]
    assert holds(note, "thrust = 0.04,", "thrust = 0.25") and "init" not in note


def test_a_target_says_what_it_leaves_free(tmp_path):
    """A cart-pole's line said nothing of the pole, which no column holds."""
    folder, file = planar(tmp_path)
    done = grounded("-C", folder, "target", "line", "--to", "x=2")
    assert "free       z, th" in done.out and "refuses" not in done.out
    file.write_text(re.sub(r"(?m)^state = .*$", "state = { x = 2, z = 3 }", file.read_text()))
    done = grounded("-C", folder, "target", "line", "--to", "x=2")
    assert holds(" ".join(done.out.split()), "[reward] weighs z", "`propose` refuses", "--to z=")
    refused = grounded("-C", folder, "propose")
    assert refused.code == 1 and holds(refused.err, "weighs", "'z'")
    found = grounded("-C", folder, "target", "line", "--to", "x=2", "--json").json
    assert found["free"] == ["z", "th", "vz"] and {*found["columns"]} == {"x", "vx"}
    ends = [word for name in ("x", "z", "th") for word in ("--to", f"{name}=1")]
    assert "free" not in grounded("-C", folder, "target", "line", *ends).out


STEERED = """
from grounded import Model
import numpy as np

def rate(s, a, p):
    return {"x": s.v * np.cos(s.psi), "y": s.v * np.sin(s.psi), "psi": s.v * np.tan(a.steer) / 0.3,
            "v": (a.speed - s.v) / 0.3}

model = Model(states={"x": "m", "y": "m", "psi": "rad", "v": "m/s"}, angles=("psi",),
              inputs={"steer": "rad", "speed": "m/s"}, derivative=rate,
              roles={"position": ("x", "y"), "heading": "psi", "speed": "v"})
"""


def limited(folder, limits):
    """Write the [limits] of a workspace that was made with --blank."""
    file = folder / "grounded.toml"
    text = re.sub(r"(?m)^\[limits\].*$", limits, file.read_text())
    assert limits in text
    file.write_text(text)


@pytest.mark.parametrize(("size", "tight"), [(1, True), (3, False)])
def test_a_target_that_turns_tighter_than_the_model_can_is_told(tmp_path, size, tight):
    """A figure-8 with turns of 0.4 m for a car that needs 0.8 m was only off by 134 mm."""
    (tmp_path / "car.py").write_text(STEERED)
    w = tmp_path / "w"
    assert grounded("init", w, "--blank", "--model", tmp_path / "car.py", "--dt", "0.05").code == 0
    limited(w, "[limits]\nsteer = [-0.36, 0.36]\nspeed = [0, 3]")
    drawn = grounded("-C", w, "target", "figure-8", "--size", f"{size}", "--speed", "1.5")
    radius = 1e3 * float(re.search(r"turning radius ([\d.]+) m", drawn.out)[1])
    assert radius == pytest.approx(417 * size, rel=0.1)
    notes = [n for n in Workspace(w).propose().proposal.notes if "tighter than the model" in n]
    assert len(notes) == tight
    for note in notes:
        asked, able = (float(mm) for mm in re.findall(r"([\d.]+) mm", note))
        assert asked == pytest.approx(radius, rel=0.01) and able > 0.9 * 0.3e3 / np.tan(0.36)
        assert holds(note, "steer is at its limits", "[limits]", f"{able / asked:.2g} times")


ROLLED = """
from grounded import Model

def rate(s, a, p):
    return {"x": s.v, "v": -7.0 * s.th, "th": s.w, "w": (0.4 * a.volt - s.w) / 0.07}

model = Model(states={"x": "m", "v": "m/s", "th": "rad", "w": "rad/s"}, inputs={"volt": "V"},
              derivative=rate)
"""


def test_rest_of_a_free_state_is_asked_for_at_the_end_only(tmp_path):
    """It took three steps: a column, its weight out of [reward] state, and into terminal."""
    (tmp_path / "ball.py").write_text(ROLLED)
    w = tmp_path / "w"
    assert grounded("init", w, "--blank", "--model", tmp_path / "ball.py", "--dt", "0.02").code == 0
    line = ("-C", w, "target", "line", "--to", "x=0.3", "--seconds", "2", "--hold", "0.5")
    said = " ".join(grounded(*line).out.split())
    assert holds(said, "not on the way", "th = 0, w = 0", "terminal", "`--rest`")
    plain_line = Workspace(w).propose().candidate
    assert grounded(*line, "--to", "th=0").code == 0
    held = Workspace(w).propose().candidate
    assert grounded(*line).code == 0
    drawn = grounded(*line, "--rest")
    assert "small error" not in drawn.err  # th and w have weights, for the end
    said = " ".join(drawn.out.split())
    assert holds(said, "[reward] terminal is new", "th = 1,000, w = 100")
    reward = tomllib.loads((w / "grounded.toml").read_text())["reward"]
    assert reward["terminal"].items() >= {"th": 1000, "w": 100}.items()
    assert reward["state"].keys() == {"x", "v"} < reward["terminal"].keys()
    assert reward["terminal"]["x"] == pytest.approx(10 * reward["state"]["x"], rel=1e-3)
    ended = Workspace(w).propose().candidate
    wanted = Workspace(w).task.target[:, 0]
    runs = [one.predicted_states for one in (plain_line, held, ended)]
    off = [np.abs(run[:, 0] - wanted).mean() for run in runs]
    assert off[2] < 1.5 * off[0] + 1e-3 and off[1] > 1.4 * off[2]
    assert abs(runs[2][-1, 2]) < 2e-3
    assert grounded(*line).code == 0  # without it again, the weights at the end go with the columns
    reward = tomllib.loads((w / "grounded.toml").read_text())["reward"]
    assert reward["terminal"].keys() == {"x", "v"} == reward["state"].keys()
    assert grounded("-C", w, "target", "step", "--to", "x=1", "--rest").code == 2


ARM = """
from grounded import Model

def rate(s, a, p):
    return {"q": s.w, "w": (0.9 * a.amps - 3.2 * s.q + 0.5 * s.q**3 - 0.05 * s.w) / 0.08}

model = Model(states={"q": "rad", "w": "rad/s"}, inputs={"amps": "A"}, derivative=rate)
"""


@pytest.mark.parametrize(("to", "said"), [("1.2", True), ("0.8", False)])
def test_a_pose_that_the_limits_can_t_hold_is_told_before_the_first_run(tmp_path, to, said):
    """Three runs of an arm were spent on 1.2 rad; `diagnose` was the first to speak of 4 A."""
    (tmp_path / "arm.py").write_text(ARM)
    w = tmp_path / "w"
    assert grounded("init", w, "--blank", "--model", tmp_path / "arm.py", "--dt", "0.02").code == 0
    bounds = "[limits]\namps = [-3.0, 3.0]\n\n[safety]\nq = [-0.3, 1.5]"
    limited(w, bounds)
    line = ("-C", w, "target", "line", "--to", f"q={to}", "--seconds", "1.5", "--hold", "0.5")
    assert grounded(*line).code == 0
    done = grounded("-C", w, "propose")
    told = " ".join((done.err + done.out).replace("\\", "").split())
    assert ("reaching and holding it" in told) is said
    # after its end it falls, from rest as well: to hold the target for longer does not help
    assert "leaves [safety] q" in told and "target line" not in told


def test_a_weight_at_the_end_is_bounded_by_the_noise_of_its_state(tmp_path, monkeypatch):
    """By a weight of 100, noise of a load's angular rate cost a quarter of the utility."""
    noise = np.array([0.01, 0.01, 0.002, 0.05])
    monkeypatch.setattr(rest_at_end, "sensor_noise", lambda *_: noise)
    (tmp_path / "ball.py").write_text(ROLLED)
    w = tmp_path / "w"
    assert grounded("init", w, "--blank", "--model", tmp_path / "ball.py", "--dt", "0.02").code == 0
    line = ("-C", w, "target", "line", "--to", "x=0.3", "--seconds", "2", "--rest")
    done = grounded(*line)
    said = " ".join((done.out + done.err).split())
    assert holds(said, "weight of w at the end is only 8.000", "0.05 rad/s", "costs 0.02")
    ends = tomllib.loads((w / "grounded.toml").read_text())["reward"]["terminal"]
    assert (ends["th"], ends["w"]) == (1000.0, 8.0)
    toml = w / "grounded.toml"
    toml.write_text(toml.read_text().replace("w = 8.0", "w = 30.0"))
    again = grounded(*line)
    assert "only" not in again.out + again.err
    assert tomllib.loads(toml.read_text())["reward"]["terminal"]["w"] == 30


def test_a_plan_that_leaves_safety_after_its_end_is_drawn_again_at_rest(tmp_path):
    """`next:` exported a plan that left [safety] 0.02 s after its end, as its note said."""
    (tmp_path / "ball.py").write_text(ROLLED)
    w = tmp_path / "w"
    assert grounded("init", w, "--blank", "--model", tmp_path / "ball.py", "--dt", "0.02").code == 0
    assert grounded("-C", w, "target", "line", "--to", "x=0.3", "--seconds", "1").code == 0
    toml = w / "grounded.toml"
    text = toml.read_text() + ("" if "[safety]" in toml.read_text() else "\n[safety]\n")
    toml.write_text(text.replace("[safety]\n", "[safety]\nx = [-0.1, 0.33]\n"))
    done = grounded("-C", w, "propose")
    said = " ".join((done.err + done.out).replace("\\", "").split())
    assert holds(said, "leaves [safety] x", "`next:` draws the same line", "as it is: `grounded")
    then = Workspace(w).propose()  # asked again, it is handed out
    assert then.then.verb == "run"
    again = said.partition("next: ")[2].split()
    line = ["target", "line", "--to", "x=0.3", "--seconds", "1", "--hold", "1", "--rest"]
    assert again == ["grounded", "-C", str(w), *line]
    old = (w / "target.csv").read_text().splitlines()
    assert grounded(*again[1:]).code == 0
    new = (w / "target.csv").read_text().splitlines()
    assert len(new) == len(old) + 50 and new[0] == "t,x,v,th,w"
    assert "leaves [safety]" not in grounded("-C", w, "propose").err


def test_a_line_keeps_the_rest_of_a_position_where_it_starts(tmp_path):
    """A line to x = 2 left the height free: the first plan of a quadrotor fell."""
    folder, file = planar(tmp_path)
    model = next(folder.glob("*.py"))
    place = "derivative=rate, roles={'position': ('x', 'z')})"
    model.write_text(model.read_text().replace("derivative=rate)", place))
    file.write_text(re.sub(r"(?m)^start = .*$", "start = { z = 1.5 }", file.read_text()))
    found = grounded("-C", folder, "target", "line", "--to", "x=2", "--json").json
    assert found["columns"] == {"x": [0, 2], "z": [1.5, 1.5], "vx": [0, 1], "vz": [0, 0]}
    weights = tomllib.loads(file.read_text())["reward"]["state"]
    assert weights["z"] == weights["x"] and weights["vz"] == weights["vx"]


def test_an_angle_of_many_turns_is_asked_about(tmp_path):
    folder, _ = planar(tmp_path)
    done = grounded("-C", folder, "target", "line", "--to", "th=45", "--to", "x=1")
    assert holds(done.err, "th = 45 rad", "7.2 turns", "--to th=0.7854")
    assert "turns" not in grounded("-C", folder, "target", "line", "--to", "th=3").err


@pytest.mark.slow
def test_a_plan_that_throws_an_input_from_end_to_end_says_so_and_what_calms_it(tmp_path):
    """A car's first plan steered from one limit to the other at each step, without a remark."""
    (tmp_path / "lifted.py").write_text(LIFTED)
    w = Workspace.create(tmp_path / "w", model=tmp_path / "lifted.py")
    wave = 50.0 * np.sign(np.sin(0.3 * np.arange(101) + 0.1))
    w.target({"h": np.full(101, 1.0), "q": wave})
    file = w.folder / "grounded.toml"
    limits = "[limits]\nthrust = [0.1, 1]\nturn = [-200, 200]"
    start = "start = { h = 1, q = 50, thrust = 0.49, turn = 50 }"
    text = re.sub(r"(?m)^start = .*$", start, file.read_text().replace("[limits]", limits))

    def told(weight: float) -> list[str]:
        calm = f"input_change = {{ turn = {weight} }}"
        changed = re.sub(r"(?m)^input_change = .*$", calm, text)
        assert calm in changed
        file.write_text(re.sub(r"(?m)^input = .*$", "input = {}", changed))
        notes = Workspace(w.folder).propose().proposal.notes
        return [note for note in notes if "turn jumps over" in note]

    assert len(told(1e-9)) == 1 and not told(1.0)


DRIVEN = """
from grounded import Model
import numpy as np

def rate(s, a, p):
    return {"x": s.v * np.cos(s.psi), "y": s.v * np.sin(s.psi) + 0.05, "psi": a.turn, "v": a.push}

model = Model(states={"x": "m", "y": "m", "psi": "rad", "v": "m/s"}, angles=("psi",),
              inputs={"turn": "rad/s", "push": "m/s^2"}, derivative=rate,
              roles={"position": ("x", "y"), "heading": "psi", "speed": "v"})
"""


@pytest.mark.parametrize("heading", [1.0, 0.3, 0.0])
def test_a_plan_off_its_path_says_which_weights_would_bring_it_closer(tmp_path, heading):
    """A current of 5 cm/s: along the path the boat has to point beside it.

    Of a lane change by 0.8 m along 5 m, 51 mm were 1 % of its extent, and not told.
    """
    (tmp_path / "driven.py").write_text(DRIVEN)
    w = Workspace.create(tmp_path / "w", model=tmp_path / "driven.py")
    t = 0.1 * np.arange(101)
    w.target({"x": 0.5 * t, "y": 0 * t, "psi": 0 * t, "v": 0.5 + 0 * t})
    file = w.folder / "grounded.toml"
    text = file.read_text().replace("[limits]", "[limits]\nturn = [-2, 2]\npush = [-2, 2]")
    text = re.sub(r"(?m)^start = .*$", "start = { v = 0.5 }", text)

    def told(place: float) -> tuple[list[str], float]:
        weights = f"state = {{ x = {place:g}, y = {place:g}, psi = {heading}, v = {heading} }}"
        file.write_text(re.sub(r"(?m)^state = .*$", weights, text))
        proposed = Workspace(w.folder).propose()
        return proposed.proposal.notes, proposed.off_target[0].rms

    notes, off = told(1.0)
    _, closer = told(10.0)
    found = [note for note in notes if "psi" in note and "x = 10, y = 10" in note]
    assert len(found) == (heading > 0)
    if heading:
        assert (
            off > (0.05 if heading == 1 else 0.02)
            and f"{1e3 * off:.0f} mm" in found[0]
            and f"{1e3 * closer:.0f} mm" in found[0]
        )


BALL = """
from grounded import Model
import numpy as np

def rate(s, a, p):
    return {"x": s.v, "v": 7 * np.sin(s.beam), "beam": (0.0015 * a.servo - s.beam) / 0.12}

model = Model(states={"x": "m", "v": "m/s", "beam": "rad"}, inputs={"servo": "deg"},
              derivative=rate)
"""


def test_a_plan_that_stops_short_says_that_its_speed_weighs_as_much(tmp_path):
    """Of 20 cm a plan lacked 6.5 mm, and 0.1 mm with less weight on the speed."""
    (tmp_path / "ball.py").write_text(BALL)
    w = Workspace.create(tmp_path / "w", model=tmp_path / "ball.py", dt=0.04)
    file = w.folder / "grounded.toml"
    text = file.read_text().replace("[limits]", "[limits]\nservo = [-45, 45]")
    file.write_text(re.sub(r"(?m)^start = .*$", "start = { x = -0.1 }", text))
    grounded("-C", w.folder, "target", "line", "--to", "x=0.1", "--seconds", "2.5", "--hold", "1")
    written = file.read_text()
    short = {}
    for speed in (0.1, 10.0, 1000.0):
        file.write_text(re.sub(r"(?m)^state = .*$", f"state = {{ x = 25, v = {speed} }}", written))
        proposed = Workspace(w.folder).propose()
        told = [note for note in proposed.proposal.notes if "x = 250" in note]
        short[speed] = proposed.off_target[0].end, told
    assert short[0.1][0] < short[10.0][0] < short[1000.0][0]
    assert not short[0.1][1] and holds(short[1000.0][1][0], "at its end", "v")


def test_an_input_that_moves_nothing_is_named(tmp_path):
    """Gains of 0 in a skeleton: the candidate sent nothing, and nobody said why."""
    idle = BALL.replace("0.0015 * a.servo", "0 * a.servo")
    (tmp_path / "ball.py").write_text(idle)
    w = Workspace.create(tmp_path / "w", model=tmp_path / "ball.py", dt=0.04)
    w.target({"x": np.linspace(0, 0.1, 51)})
    notes = w.propose().proposal.notes
    assert any(holds(note, "servo", "model.py") and "no state" in note for note in notes)
    (w.folder / "model.py").write_text(BALL)
    assert not any("no state" in note for note in Workspace(w.folder).propose().proposal.notes)


def test_a_target_start_or_safety_in_another_unit_than_the_model_s_is_told(tmp_path):
    """A target drawn in degrees, and a [safety] in mm, were planned and guarded as they stood."""
    (tmp_path / "balanced.py").write_text(BALANCED)
    t = np.arange(200) * 0.05
    rows = np.column_stack([t, np.sin(t), 0.4 * np.sin(t), np.cos(t), 0.4 * np.cos(t), np.sin(t)])
    np.savetxt(tmp_path / "r.csv", rows, "%.5f", ",", header="t,x,th,v,w,u", comments="")
    folder = tmp_path / "w"
    begin(folder, tmp_path / "r.csv", model=tmp_path / "balanced.py")
    assert grounded("-C", folder, "ingest", "--data", tmp_path / "r.csv").code == 0
    file = folder / "grounded.toml"
    before = file.read_text()

    def told(start: str = "", safety: str = "") -> list[str]:
        text = re.sub(r"(?m)^start = .*$", f"start = {{ {start} }}", before)
        file.write_text(re.sub(r"(?m)^\[limits\]$", f"[safety]\n{safety}\n\n[limits]", text))
        return in_another_unit(Folder(folder))

    assert not told() and not told("th = 0.3", "x = [-3, 3]\nth = [-6, 6]")
    assert not told("", "x = [-1e6, 1e6]")  # as good as none, in mm too
    (note,) = told("th = 20")
    assert holds(note, "[task] start of th is 20 rad", "50 times", "degrees", "0.017453293")
    (note,) = told("", "x = [-1500, 1500]")
    assert holds(note, "[safety] of x is 1500 m", "mm", "0.001")
    assert note in Workspace(folder).propose().proposal.notes
    columns = np.genfromtxt(folder / "target.csv", delimiter=",", names=True)
    columns["th"] *= 57.3
    names = columns.dtype.names
    values = np.column_stack([columns[n] for n in names])
    np.savetxt(folder / "target.csv", values, "%.5f", ",", header=",".join(names), comments="")
    (note,) = told()
    assert note.startswith("the target of th is 22.9")


def test_a_first_plan_that_is_refused_for_its_gains_says_nothing_of_safety(tmp_path, monkeypatch):
    """`draw a target whose run stays inside [safety]` was said of a gain of 1e7."""
    monkeypatch.setattr("grounded.search.safety.MAX_GAIN", 1e-3)
    proposed = Workspace(make(tmp_path / "w").folder).propose()
    assert proposed.candidate is None and proposed.standing.ending == "gains too large"
    assert not any("[safety]" in note for note in proposed.proposal.notes)
    assert proposed.then.verb == "propose"  # of other weights
