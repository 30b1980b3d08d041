"""Gains are compared in all models that explain the trials; doubtful candidates are reported."""

import importlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from grounded.model import Model, Param
from grounded.plant import Noise, Plant
from grounded.search.first_policy import first_policy
from grounded.search.improve import propose
from grounded.search.making import About, Maker
from grounded.search.planner import Planner, model_fingerprint
from grounded.search.standing import standing
from grounded.search.step.step_size import SearchOptions
from grounded.trial import Trial
from grounded.utility import Reward
from grounded_trials.workspace.adopted import planner_of
from grounded_trials.workspace.off_target import began_elsewhere
from small_tasks import cart_task, drive

OPTIONS = SearchOptions()


def balance(s, a, p):
    return {"x": s.v, "v": 9.0 * s.x + a.force / p.mass}


@pytest.fixture
def noisy():
    """An unstable system with noise after four trials, and the model grounded on the best."""
    model = Model(
        name="balance",
        states={"x": "m", "v": "m/s"},
        inputs={"force": "N"},
        params={"mass": Param(1.0, "kg", 0.1, 10.0)},
        roles={"position": ("x",), "speed": "v"},
        derivative=balance,
    )
    reward = Reward(np.array([10.0, 0.0]), np.zeros(2), np.array([0.1]), np.array([0.01]))
    task = cart_task(model=model, reward=reward, low=np.array([-30.0]), high=np.array([30.0]))
    noise = Noise(process={"x": 0.003, "v": 0.03}, measurement={"x": 0.002, "v": 0.01})
    plant = Plant(model.with_values({"mass": 1.2}), noise=noise)
    candidates, trials = [], []
    for seed in range(4):
        made = propose(task, candidates, trials, OPTIONS)
        candidates += [made.candidate] if made.is_new else []
        trials.append(drive(task, plant, made.candidate, seed))
    planner, fingerprint = Planner(task, task), model_fingerprint(task)
    now = standing(task, candidates, trials, OPTIONS, fingerprint)
    about = About(Maker(planner, now, "c0099", fingerprint), now.incumbent, OPTIONS, "")
    return SimpleNamespace(task=task, plant=plant, now=now, about=about, planner=planner)


@pytest.mark.slow
def test_a_plan_with_dry_friction_is_followed_from_a_wider_kink(monkeypatch):
    """A cart that sticks has no slope: its plan stopped half a per cent short of the best."""
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[3]))
    task = importlib.import_module("benchmarks.foreign.mechanisms").cart_task("gentle")
    friction = {"name": "joint_friction:force<-x_vel", "c": 0.8, "b": 0.0, "width": 0.005}
    planner = planner_of(task, [friction])
    assert planner.widths == ("joint_friction_force_from_x_vel_width",)
    _, plain = first_policy(planner.plan)
    _, followed = planner.first_policy()
    assert followed.cost < plain.cost - 0.2


def test_the_noise_of_a_filtered_speed_is_no_start_elsewhere():
    task, false = cart_task(), 0
    said = begun(task).states
    for seed in range(20):
        rng, states, slow = np.random.default_rng(seed), np.array(said), 0.0
        noise = []
        for white in rng.standard_normal(len(states) + 50):
            slow += task.dt / 0.08 * (white - slow)
            noise.append(slow)
        states[:, 1] += 0.03 * np.array(noise[50:]) / np.std(noise)
        run = replace(begun(task), states=states)
        false += bool(began_elsewhere(task, [run], said).get("v"))
    assert false <= 1
    states = np.array(said)
    states[:, 1] += 0.3 * np.exp(-np.arange(len(states)) * task.dt)
    assert "v" in began_elsewhere(task, [replace(begun(task), states=states)], said)


def begun(task, off=0.0, noise=0.0, seed=0):
    """Return a run that follows the target, started at `off`, with a noisy position sensor."""
    states = np.nan_to_num(task.target)
    states[:, 0] += off + noise * np.random.default_rng(seed).standard_normal(len(states))
    names = (task.model.state_names, task.model.input_names)
    return Trial(states, np.zeros((len(states) - 1, 1)), task.dt, *names)
