"""Trials told in Python are checked as a log is on ingest: did they run their candidate?"""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import grounded as gr
from facts import holding, holds
from grounded.plant import Plant
from small_tasks import drive, other, rover_task

TASK = rover_task()
PLANT = Plant(other(TASK.model, 1.15), latency={"speed": 0.06, "turn": 0.06})
ONE = gr.SearchOptions(max_trials=1)


def run(candidate):
    return drive(TASK, PLANT, candidate)


def scaled(trial, *by):
    return replace(trial, inputs=trial.inputs * np.array(by))


def nan(trial):
    return replace(trial, states=np.full_like(trial.states, np.nan))


WRONG = [
    (lambda t: scaled(t, 1, -1), ("turn", "opposite sign")),
    (lambda t: scaled(t, -1, -1), ("c0001",)),
    (lambda t: replace(t, inputs=t.inputs + 50), ("c0001", "rms")),
    (lambda t: replace(t, inputs=0 * t.inputs + 0.3), ("c0001", "rms")),
    (lambda t: replace(t, states=0 * t.states), ("c0001", "rms")),
    (lambda t: replace(t, states=t.states + 5), ("c0001", "rms")),
    (nan, ("x", "finite")),
]


@pytest.mark.parametrize(("change", "facts"), WRONG)
def test_a_trial_that_is_not_its_candidate_s_run(change, facts):
    with pytest.raises(gr.TrialRefused, match=holding(*facts)) as refused:
        gr.learn(TASK, lambda c: change(run(c)), ONE)
    assert refused.value.search.trials == ()
    assert "ingest" not in str(refused.value) and "[log" not in str(refused.value)
    assert len(gr.learn(TASK, lambda c: change(run(c)), ONE, check=False).trials) == 1
    search = gr.Search(TASK)
    with pytest.warns(UserWarning, match=holding(*facts)):
        search.tell(change(run(search.ask())))
    assert len(search.trials) == 1


def test_runs_of_their_candidates_under_noise_are_no_reason_to_warn():
    rng, search = np.random.default_rng(0), gr.Search(TASK)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(3):
            trial = run(search.ask())
            off = rng.normal(0, 1e-3, trial.states.shape)
            search.tell(replace(trial, states=trial.states + off))


def test_a_crash_is_reported():
    search = gr.Search(TASK)
    with pytest.warns(UserWarning, match=holding("c0001", "30", TASK.horizon)):
        search.tell(run(search.ask()).until(30))
    assert holds(search.standing.sentence, "c0001", "crashed")
    assert search.standing.history[0].verdict() == "crashed"


def test_adopted_values_must_lie_within_the_bounds():
    name = next(iter(TASK.model.params))
    bounded = replace(TASK.model, params=TASK.model.params | {name: gr.Param(1.0, "1", 0.5, 2.0)})
    search = gr.Search(TASK.with_model(bounded))
    assert search.adopt({}, {name: 2.0}).planner.task.model.params[name].value == 2.0
    for value in (2.5, 0.1, float("nan"), "1"):
        with pytest.raises(gr.GroundedError, match=holding(name, str(value))):
            search.adopt({}, {name: value})


def test_a_reward_without_a_weight_gives_nothing_to_plan():
    reward = TASK.reward
    none = {name: 0 * getattr(reward, name) for name in ("state", "terminal", "input")}
    idle = replace(TASK, reward=replace(reward, **none, input_change=0 * reward.input_change))
    with pytest.raises(gr.GroundedError, match=holding("weight", "0")):
        gr.Search(idle).ask()


def test_a_velocity_in_another_unit_is_corrected_by_a_factor_and_no_key():
    """An open-loop policy's commands show no unit, so the columns are compared."""
    model = gr.Model(
        states={"x": "m", "v": "m/s"},
        inputs={"force": "N"},
        derivative=lambda s, a, p: {"x": s.v, "v": a.force - s.v},
    )
    target = np.column_stack([np.linspace(0, 1, 41), np.full(41, np.nan)])
    task = gr.Task(
        model=model,
        dt=0.05,
        target=target,
        reward=gr.Reward(state=[1.0, 0], terminal=[1.0, 0], input=[0.01], input_change=[0.01]),
        start=np.zeros(2),
        past=np.zeros(1),
        low=np.array([-5.0]),
        high=np.array([5.0]),
        feedback=False,
    )
    search = gr.Search(task)
    trial = drive(task, Plant(model), search.ask())
    with pytest.warns(UserWarning, match=holding("v", "mm")) as told:
        search.tell(replace(trial, states=trial.states * np.array([1.0, 1e3])))
    assert "[log" not in str(told[0].message)
