"""After `adopt` the changed model's own plan is run with its own gains, when it is due."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from grounded.model import Model, Param
from grounded.plant import Noise, Plant
from grounded.search.feedback.oscillation import between_limits, limit_cycle
from grounded.search.improve import propose
from grounded.search.planner import Planner
from grounded.search.step.step_size import SearchOptions
from grounded.task import Task
from grounded.utility import Reward
from grounded_trials.workspace.adopted import planner_of
from small_tasks import drive

OPTIONS = SearchOptions()


def boom(s, a, p):
    return {"th": s.w, "w": (p.K * a.u - s.w) / p.tau}


def valve_and_oil(s, a, p):
    """A hydraulic valve with delay and lag, a dead zone, and the compressibility of the oil."""
    flow = p.K * np.sign(s.spool) * np.maximum(np.abs(s.spool) - 0.08, 0.0) - 0.01 * np.cos(s.th)
    return {
        "th": s.w,
        "w": s.dw,
        "dw": 144.0 * (flow - s.w) - 9.6 * s.dw,
        "spool": np.clip((a.u - s.spool) / 0.04, -4.0, 4.0),
    }


@pytest.fixture
def late_boom():
    """The task, its plant, two trials of the crude search, and the planner after adopting."""
    own = {"K": Param(0.5, "rad/s", 0.2, 1.0), "tau": Param(0.15, "s", 0.03, 0.6)}
    states = {"th": "rad", "w": "rad/s"}
    crude = Model(states=states, inputs={"u": "1"}, params=own, derivative=boom)
    true = Model(
        states={**states, "dw": "rad/s2", "spool": "1"},
        inputs={"u": "1"},
        params={"K": Param(0.5, "rad/s")},
        derivative=valve_and_oil,
    )
    t = np.clip(np.linspace(0.0, 1.2, 76), 0.0, 1.0)
    th = 0.1 + 0.35 * (10 * t**3 - 15 * t**4 + 6 * t**5)
    task = Task(
        model=crude,
        dt=0.04,
        target=np.column_stack([th, np.gradient(th, 0.04)]),
        reward=Reward(
            np.array([10.0, 1.0]), np.array([100.0, 20.0]), np.zeros(1), np.array([0.01])
        ),
        start=np.array([0.1, 0.0]),
        past=np.zeros(1),
        low=np.array([-1.0]),
        high=np.array([1.0]),
    )
    noise = Noise(measurement={"th": 3e-4, "w": 1e-2})
    plant = Plant(true, latency={"u": 0.06}, noise=noise, substeps=20)
    found = task.with_model(crude.with_values({"K": 0.41, "tau": 0.1}))
    effects = [{"name": "rate_limit:u", "r": 7.5}, {"name": "delay:u", "d": 0.12}]
    better = replace(planner_of(found, effects), task=task)
    run = SimpleNamespace(task=task, plant=plant, better=better, candidates=[], trials=[])
    for _ in range(2):
        step(run, Planner(task, task))
    return run


def step(run, planner):
    """Run one more trial; return the candidate and the utility."""
    made = propose(run.task, run.candidates, run.trials, OPTIONS, planner=planner)
    run.candidates += [made.candidate] * made.is_new
    run.trials.append(drive(run.task, run.plant, made.candidate, len(run.trials)))
    return made.candidate, run.task.utility(run.trials[-1])


def test_the_changed_models_plan_is_run_with_its_own_gains(late_boom):
    best = max(map(late_boom.task.utility, late_boom.trials))
    made, utility = step(late_boom, late_boom.better)
    afresh = SimpleNamespace(**vars(late_boom) | {"candidates": [], "trials": []})
    first, fresh = step(afresh, late_boom.better)
    assert made.way == "own plan" and first.way == "" and not first.base
    off = np.abs(made.policy.gain - first.policy.gain).mean()  # each as gentle as its margin asks
    assert off < 0.5 * np.abs(first.policy.gain).mean()
    assert best < 10 * utility
    assert utility == pytest.approx(fresh, rel=0.1)


def test_an_input_that_is_at_both_limits_for_long_swings_between_them():
    task = SimpleNamespace(low=np.array([-1.0]), high=np.array([1.0]))
    noisy = 0.7 * np.sin(np.arange(60.0))[:, None]
    for inputs, expected in ((noisy, False), (np.sign(noisy), True), (np.abs(noisy) * 9, False)):
        trial = SimpleNamespace(inputs=np.clip(inputs, -1.0, 1.0))
        assert between_limits(SimpleNamespace(trials=[trial]), task) == expected


def test_noise_about_an_input_that_is_off_lastingly_is_no_limit_cycle():
    """An arm that sags under a load does not get gentler gains: it would sag more."""
    task = SimpleNamespace(low=np.array([-20.0]), high=np.array([20.0]))
    plan = np.linspace(0.0, 0.5, 80)[:, None]
    made = SimpleNamespace(predicted_inputs=plan)
    noise = np.tile([0.4, -0.4], 40)[:, None]
    for held, expected in ((0.0, True), (5.0, False)):
        trial = SimpleNamespace(inputs=plan + noise + held, steps=80)
        assert limit_cycle(SimpleNamespace(candidate=made, trials=[trial]), task) == expected
