"""What a plan assumes before its start, if the logs show where the robot stood."""

import numpy as np
import pytest

from cli import grounded
from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.store.trial_file import write_trial
from workspaces import blank

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
    effects = f'{{name = "sensor_bias:beam", b = {B}}}'
    start = "{ x = -0.15 }"
    w = blank(tmp_path / "w", BALL, dt=DT, limits="u = [-3, 3]", effects=effects, start=start)
    grounded("-C", w.folder, "target", "line", *LINE)
    return w


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
    notes = Workspace(w.folder).propose().notes
    return " ".join(note for note in notes if "start = " in note)


@pytest.mark.parametrize(
    ("stood", "beam", "told"), [(0.6, 0.0, False), (0.1, 0.0, True), (0.6, B, True)]
)
def test_no_start_is_offered_where_the_robot_stood_in_its_logs(ball, tmp_path, stood, beam, told):
    w = stored(ball, driven(stood, x=-0.1, beam=beam), tmp_path)
    assert bool(offered(w)) == told
