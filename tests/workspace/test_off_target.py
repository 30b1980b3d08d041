"""How far a run is off its target, in units: the numbers that a utility does not say."""

import math

import numpy as np
import pytest

from grounded import Model, Task, Trial
from grounded.result import measured_alike
from grounded.task import Reward
from grounded_trials import Workspace
from grounded_trials.report.gathering import gather
from grounded_trials.report.tables import improved
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.off_target import off_target_of
from reported import cart, copied

__all__ = ["cart"]

NAMES = ("x", "y", "psi", "v")
ROVER = Model(
    states=dict(zip(NAMES, ("m", "m", "rad", "m/s"), strict=True)),
    inputs={"turn": "rad/s", "push": "m/s^2"},
    angles=("psi",),
    roles={"position": ("x", "y")},
    derivative=lambda s, a, p: {"x": s.v, "y": 0 * s.v, "psi": a.turn, "v": a.push},
)
H, DT = 20, 0.1


def task(state=(0, 0, 0, 0), terminal=(0, 0, 0, 0)):
    """To stay at zero; the speed is free."""
    target = np.zeros((H + 1, 4))
    target[:, 3] = np.nan
    weights = Reward(np.array(state, float), np.array(terminal, float), np.ones(2), np.ones(2))
    limits = {"low": np.full(2, -1.0), "high": np.ones(2)}
    return Task(ROVER, DT, target, weights, start=np.zeros(4), past=np.zeros(2), **limits)


def run(states):
    names = (ROVER.state_names, ROVER.input_names)
    return Trial(states, np.zeros((len(states) - 1, 2)), DT, *names)


def off(x=0.0, y=0.0, psi=0.0, steps=H):
    states = np.zeros((steps + 1, 4))
    states[:, 0], states[:, 1], states[:, 2] = x, y, psi
    return states


ALONG = (1, 1, 0.1, 0)


def test_the_position_is_one_distance_and_angles_are_wrapped():
    states = off(0.003, 0.004, 2 * np.pi - 0.01)
    states[15, :2] = (0.03, 0.04)
    position, psi = off_target_of(task(ALONG), [run(states)])
    assert (position.what, position.unit) == ("position", "m")
    assert position.most == pytest.approx(0.05) and position.at_s == pytest.approx(1.5)
    assert position.rms == pytest.approx(math.sqrt((20 * 0.005**2 + 0.05**2) / 21))
    assert math.isnan(position.end)
    assert (psi.what, psi.most) == ("psi", pytest.approx(0.01))


def test_status_and_ingest_say_the_number_of_the_page(cart, tmp_path):
    folder = copied(cart, tmp_path / "cart")
    w = Workspace(folder)
    (told, *_) = w.status().off_target
    (first, *_) = off_target_of(w.task, [w.trials()[0].trial])
    rows = dict(map(reversed, improved(gather(Folder(folder)))))
    both = measured_alike([first.rms, told.rms], told.unit)
    assert rows[f"{told.what} off target, rms"] == " -> ".join(both)
    document = w.status().to_json()["best"]["off_target"][0]
    assert (document["what"], document["rms"]) == (told.what, pytest.approx(told.rms))
    best = w.trials()[-1]
    again = w.ingest(best.stored.path)
    assert again.off_target == off_target_of(w.task, [best.trial])
    assert again.to_json()["off_target"][0]["unit"] == told.unit


def test_propose_says_how_far_the_predicted_run_is_off(cart, tmp_path):
    folder = copied(cart, tmp_path / "cart")
    w = Workspace(folder)
    way = np.linspace(0, 1, w.task.horizon + 1)
    w.target({"x": 0.3 * way**2 * (3 - 2 * way)})
    proposed = w.propose()
    target = w.task.target[:, 0]
    error = np.abs(proposed.candidate.predicted_states[:, 0] - target)
    told = next(one for one in proposed.off_target if one.what == "x")
    assert told.rms == pytest.approx(np.sqrt(np.mean(error**2))) and told.most == error.max() > 0
    assert proposed.to_json()["off_target"][0]["what"] == "x"
