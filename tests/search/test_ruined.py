"""The original model takes no step that would ruin the run in the adopted one."""

from dataclasses import replace

import numpy as np

from grounded.plant import Noise, Plant
from grounded.search import improve
from grounded.search.improve import propose
from grounded.search.making import About
from grounded.search.planner import Planner, planner_with
from grounded.search.step.step_size import SearchOptions
from grounded.utility import Reward
from small_tasks import cart_task, drive


def test_a_step_without_the_adopted_delay_is_not_run(monkeypatch, delay=0.1, noise=0.02):
    def bare(about):
        make = replace(
            about.make, planner=Planner(about.make.planner.task, about.make.planner.task)
        )
        return About(make, about.incumbent, about.options, original=True)

    monkeypatch.setattr(improve, "trusted", bare)
    reward = Reward(np.array([10.0, 0.0]), np.zeros(2), np.array([1e-4]), np.array([1e-4]))
    task = cart_task(reward=reward, low=np.array([-50.0]), high=np.array([50.0]))
    planner = replace(planner_with(task, [("delay:force", {"d": delay})]), task=task)
    plant = Plant(task.model, latency={"force": delay}, noise=Noise(process={"v": noise}))
    first = propose(task, [], [], SearchOptions(), planner=planner).candidate
    trial = drive(task, plant, first)
    made = propose(task, [first], [trial], SearchOptions(), planner=planner).candidate
    if made is not None:
        assert task.utility(drive(task, plant, made, 1)) > 5 * task.utility(trial)
