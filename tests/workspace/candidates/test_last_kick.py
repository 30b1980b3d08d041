"""A plan that reaches its target by a kick of its last commands is told before it is run."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from facts import holds
from grounded.trial import Trial
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.remarks.after_run import kicked, moved_on
from small_tasks import rover_task
from workspaces import CONFIG, MODEL, make

ENDS = CONFIG.replace("{ x = 10.0 }", "{ }\nterminal = { x = 100.0 }")


@pytest.mark.parametrize(
    ("last", "lag", "said"),
    [
        (5.0, 0.1, True),  # at its limit, and moving when it ends
        (1.0, 0.1, False),  # moving, but by no kick
        (5.0, 0.0, False),  # at its limit and at rest
    ],
)
def test_what_is_on_target_for_one_sample_only_is_told(tmp_path, last, lag, said):
    assert ENDS != CONFIG
    planner = Folder(make(tmp_path / "w", config=ENDS).folder).planner
    task = planner.task
    states, inputs = np.array(task.target), np.zeros((task.horizon, 1))
    states[np.isnan(states)] = 0.0
    states[-1] = [states[-1, 0], lag]
    inputs[-3:] = last
    run = Trial(states, inputs, task.dt, ("x", "v"), ("force",))
    told = kicked(planner, run, np.zeros(1))
    assert bool(told) == said
    if said:
        assert holds(told, "force at a limit", "one sample", "--hold")


def test_a_plan_that_rests_against_a_force_is_no_kick(tmp_path):
    model = MODEL.replace("a.force - p", "a.force - 5.0 * s.x - p")
    assert model != MODEL
    planner = Folder(make(tmp_path / "w", config=ENDS, model=model).folder).planner
    task = planner.task
    states, inputs = np.array(task.target), np.full((task.horizon, 1), 5.0)
    states[np.isnan(states)] = 0.0
    run = Trial(states, inputs, task.dt, ("x", "v"), ("force",))
    told = kicked(planner, run, np.zeros(1))
    assert holds(told, "force at a limit", "force = 0 N", "lets it go", "runner.done(t)")
    assert "one sample" not in told and "--hold" not in told


@pytest.mark.parametrize(("turned", "noise"), [(0.0, 0.0), (0.008, 0.0), (0.0, 0.003)])
def test_a_heading_that_turns_after_the_run_is_told_if_the_end_would_cost_more(turned, noise):
    task = rover_task()
    weights = replace(task.reward, terminal=np.array([100.0, 100.0, 300.0]))
    T, rest = task.horizon, 12
    target = np.vstack([np.repeat(task.target[:1], T // 2, 0), np.repeat(task.target[-1:], T, 0)])
    task = replace(task, reward=weights, target=target[: T + 1])
    states = np.vstack([task.target, np.repeat(task.target[-1:], rest, 0)])
    states[T + 3 :, 2] += turned
    states[:, 2] += noise * np.random.default_rng(1).standard_normal(len(states))
    states[T, 2] = task.target[-1, 2]
    inputs = np.zeros((len(states) - 1, 2))
    names = task.model.state_names, task.model.input_names
    run = Trial(states, inputs, task.dt, *names)
    told = moved_on(SimpleNamespace(task=task), run)
    assert (told is not None) == bool(turned)
    assert not told or holds(told.said, "psi was 0.0080 rad from its target", "[reward]")
