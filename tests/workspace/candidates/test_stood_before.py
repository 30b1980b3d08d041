"""What a plan assumes before its start, if the logs show where the robot stood."""

import re

import numpy as np
import pytest

from cli import grounded
from facts import holds
from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.store.trial_file import write_trial
from grounded_trials.workspace.candidates import at_rest
from grounded_trials.workspace.folder import Folder

DT, ROWS, B = 0.02, 200, -0.0173
BALL = """
from grounded import Model

def rate(s, a, p):
    return {"x": s.v, "v": 7.0 * s.beam - 0.1 * s.v, "beam": s.w, "w": 8.0 * (a.u - s.w)}

model = Model(states={"x": "m", "v": "m/s", "beam": "rad", "w": "rad/s"}, inputs={"u": "rad/s"},
              derivative=rate)
"""
LINE = ("--to", "x=0.15", "--seconds", "2.5", "--hold", "1")


@pytest.fixture
def ball(tmp_path) -> Workspace:
    """Return a workspace with an adopted zero error of the beam's encoder."""
    (tmp_path / "mine.py").write_text(BALL)
    w = Workspace.create(tmp_path / "w", model=tmp_path / "mine.py")
    file = w.folder / "grounded.toml"
    text = re.sub(r"(?m)^dt = \S+", f"dt = {DT}", file.read_text())
    text = text.replace("[limits]", "[limits]\nu = [-3, 3]")
    effects = f'effects = [{{name = "sensor_bias:beam", b = {B}}}]\n[task]'
    file.write_text(
        re.sub(r"(?m)^start = .*$", "start = { x = -0.15 }", text).replace("[task]", effects, 1)
    )
    grounded("-C", w.folder, "target", "line", *LINE)
    return Workspace(w.folder)


def driven(stood: float, x: float = -0.15, beam: float = 0.0) -> Trial:
    """Return a log of the ball, held for `stood` seconds before the beam turns."""
    t = np.arange(ROWS + 1) * DT
    after = np.maximum(t - stood, 0.0)
    angle = 0.1 * np.sin(2 * after)
    v = 0.35 * (1 - np.cos(2 * after))
    states = np.column_stack([x + np.cumsum(v) * DT, v, beam + angle, 0.2 * np.cos(2 * after)])
    states[after == 0, 3] = 0.0
    u = np.where(after > 0, np.cos(2 * after), 0.0)[:-1, None]
    return Trial(states, u, DT, ("x", "v", "beam", "w"), ("u",))


def stored(w: Workspace, trial: Trial, tmp_path) -> Workspace:
    write_trial(tmp_path / "log.mcap", trial, {"kind": "trial"})
    w.ingest(tmp_path / "log.mcap", data=True)
    return Workspace(w.folder)


def offered(w: Workspace) -> str:
    notes = Workspace(w.folder).propose().proposal.notes
    return " ".join(note for note in notes if "the plan assumes" in note)


def test_a_start_is_offered_only_to_a_robot_that_nothing_but_its_inputs_holds(ball):
    """A finger held a ball "at rest" on a beam out of level: the start cost it half its utility."""
    words = ("If nothing but its inputs holds the robot before the run (no hand, no stop)",)
    assert holds(offered(ball), *words, f"start = {{ x = -0.15, beam = {B}, u = 0 }}")


def test_an_angle_at_rest_is_told_without_whole_turns(ball, monkeypatch):
    """Against the current a boat rests at a heading of -0.965 rad: `psi = 269.2` was offered."""
    file = next(ball.folder.glob("*.py"))
    file.write_text(
        file.read_text().replace("derivative=rate)", 'derivative=rate, angles=["beam"])')
    )
    found = at_rest.resting

    def turned(*given):
        stands = found(*given)
        return None if stands is None else stands + 86 * np.pi * (np.arange(len(stands)) == 2)

    monkeypatch.setattr(at_rest, "resting", turned)
    assert f"start = {{ x = -0.15, beam = {B}, u = 0 }}" in offered(ball)


@pytest.mark.parametrize(
    ("stood", "beam", "told"),
    [(0.6, 0.0, False), (0.1, 0.0, True), (0.6, B, True)],
)
def test_no_start_is_offered_where_the_robot_stood_in_its_logs(ball, tmp_path, stood, beam, told):
    """A hand log began with half a second of a ball held where the plan begins."""
    w = stored(ball, driven(stood, x=-0.1, beam=beam), tmp_path)
    assert bool(offered(w)) == told


def test_what_a_sensor_read_at_a_standstill_is_no_start_to_correct(ball, tmp_path):
    """`a true 0 is -0.0173 there, but [task] start is 0 rad`: a finger held the ball there."""

    def note() -> str:
        done = grounded("-C", ball.folder, "target", "line", *LINE, "--to", "beam=0")
        return " ".join(done.err.split())

    assert "[task] start is 0 rad" in note()
    stored(ball, driven(0.6), tmp_path)
    assert holds(note(), "the target ends at 0 rad") and "[task] start is" not in note()


@pytest.mark.parametrize(("stood", "told"), [(0.6, True), (0.1, False)])
def test_a_start_at_which_no_run_begins_is_told_with_the_one_to_write(ball, tmp_path, stood, told):
    """The runs began 0.0173 rad off an obeyed note's start, and nothing said what to put back."""
    stored(ball, driven(stood, x=-0.1), tmp_path)
    file = ball.folder / "grounded.toml"
    start = f"start = {{ x = -0.15, beam = {B}, u = 0 }}"
    file.write_text(re.sub(r"(?m)^start = .*$", start, file.read_text()))
    w = Workspace(ball.folder)
    w.propose()
    made, _ = Folder(w.folder).candidate("c0001")
    run = made.predicted_run
    states = np.array(run.states[:, :4]) + 1e-4 * np.random.default_rng(0).standard_normal(
        (len(run.states), 4)
    )
    states[:, 2] -= B * np.exp(-np.arange(len(states)) / 10)
    (tmp_path / "run.mcap").unlink(missing_ok=True)
    write_trial(
        tmp_path / "run.mcap",
        Trial(states, run.inputs, DT, ("x", "v", "beam", "w"), ("u",)),
        {"kind": "trial"},
    )
    done = grounded("-C", ball.folder, "ingest", tmp_path / "run.mcap", "--candidate", "c0001")
    said = " ".join(done.err.split())
    assert ("write start = { x = -0.15, beam = " in said and "so did t0001" in said) == told, said


def test_what_to_add_a_bias_to_is_named_by_what_the_task_gives(ball, tmp_path):
    """`add -0.0173 to it`: to the target, which had no column of the beam."""
    from grounded_cli.adopt import _as_read

    def told() -> str:
        return _as_read(Workspace(ball.folder), "beam", f"{B} rad", B)

    assert holds(told(), "neither [task] start nor the target names it", f"write beam = {B}")
    grounded("-C", ball.folder, "target", "line", *LINE, "--to", "beam=0")
    assert told() == f"add {B} rad to beam in the target, unless this sensor measured it"
    stored(ball, driven(0.6), tmp_path)
    assert holds(told(), "leave [task] start", "in t0001, and add", "beam in the target")
    grounded("-C", ball.folder, "target", "line", *LINE)
    assert told().endswith("; the target names no beam")
