"""What the first plan of a task tells: what holds its start, and what its target leaves free."""

import re

import numpy as np

from cli import grounded
from facts import holds
from grounded_trials import Workspace

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
        notes = [n for n in Workspace(w.folder).propose().proposal.notes if "counts as held" in n]
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
