"""A robot whose program acts on old samples runs new policies as predicted all the same."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.policy import z_difference
from grounded.rollout import for_late_samples, simulate
from grounded.search.candidate import Tried
from grounded.search.feedback.sample_age import different, planned_age, run_ages, sample_age
from grounded.search.improve import propose
from grounded.search.step.step_size import SearchOptions
from grounded.trial import Trial
from small_tasks import rover, rover_task

AGE = 0.015  # [s], 0.3 steps: at 1 m/s the rover is 15 mm further than its program believes
REAL = rover.with_values({"yaw": 0.9, "dead": 0.1})


def driven(task, made, age=AGE, seed=None, model=REAL):
    """The rover's log: states at the time of each command, which was made from older ones."""
    policy, rng = made.policy, np.random.default_rng(seed)
    x, u = [task.start], []
    for t in range(task.horizon):
        before = x[max(t - 1, 0)]
        seen = x[t] + age / task.dt * (before - x[t])
        z = np.concatenate([seen, u[-1] if u else policy.past])
        off = z_difference(z, policy.reference[t], policy.angles)
        u.append(np.clip(policy.feedforward[t] + policy.gain[t] @ off, task.low, task.high))
        x.append(model.system.step(x[t][None], u[t][None], model.values, task.dt)[0])
    states = np.array(x)
    if seed is not None:
        states = states + rng.normal(0, 0.002, states.shape)
    names = (made.policy.state_names, made.policy.input_names)
    return Trial(states, np.array(u), task.dt, *names, candidate=made.id, id=f"t{made.id}")


def first(task):
    return propose(task, [], [], SearchOptions()).candidate


@pytest.mark.parametrize(("age", "seed"), [(AGE, 0), (-0.01, None)])
def test_the_age_is_found_from_commands_and_states(age, seed):
    task = rover_task()
    made = first(task)
    found = sample_age(task, made, [driven(task, made, age, seed)])
    assert found == pytest.approx(age, abs=0.003 if seed is None else 0.005)


@pytest.mark.parametrize("share", [0.4, 0.9])
def test_the_age_is_found_in_a_run_that_was_stopped(share):
    task = rover_task()
    made = first(task)
    stopped = driven(task, made, 0.04).until(round(share * task.horizon))
    assert sample_age(task, made, [stopped]) == pytest.approx(0.04, abs=0.004)
    padded = replace(stopped, states=stopped.whole(task.horizon).states)
    padded = replace(padded, inputs=stopped.whole(task.horizon).inputs)
    assert sample_age(task, made, [padded]) == sample_age(task, made, [stopped])
    assert sample_age(task, made, [stopped.until(2)]) == 0.0


@pytest.mark.parametrize("seed", [0])
def test_fresh_samples_have_no_age_though_logs_are_noisy(seed):
    task = rover_task()
    made = first(task)
    assert sample_age(task, made, [driven(task, made, 0.0, seed)]) == 0.0


def test_a_model_that_replays_a_trial_replays_it_with_its_policy_on_old_samples():
    """The policy on fresh samples ran elsewhere in the grounded model than on the robot."""
    task = rover_task()
    made = first(task)
    trial = driven(task, made)
    second = propose(task, [made], [trial], SearchOptions()).candidate
    assert second.sample_age == pytest.approx(AGE, abs=0.002)
    # what the model gives the first policy is what it had on the robot
    assert second.expected_of_base == pytest.approx(task.utility(trial), rel=0.02)


def test_a_policy_for_late_samples_runs_as_planned():
    task = rover_task()
    planned, late = first(task).policy, replace(task.problem(exact=True), age=0.6 * task.dt)
    fresh = simulate(replace(late, age=0.0), planned)
    again = simulate(late, for_late_samples(planned, late))
    np.testing.assert_allclose(again.states, fresh.states, atol=1e-6)
    assert np.abs(simulate(late, planned).states - fresh.states).max() > 0.01


def test_a_plan_is_for_the_mean_age_if_it_differs_from_run_to_run():
    task = rover_task()
    made = first(task)

    def tried(*ages):
        trials = tuple(driven(task, made, age) for age in ages)
        return Tried(made, trials, tuple(task.utility(one) for one in trials), accepted=True)

    steady, other = tried(0.014, 0.016), tried(0.002)
    alone = sample_age(task, made, steady.trials)
    assert planned_age(task, steady, run_ages(task, [steady])) == alone
    ages = run_ages(task, [steady, other])
    assert ages == pytest.approx([0.014, 0.016, 0.002], abs=0.003)
    assert planned_age(task, steady, ages) == pytest.approx(np.mean(ages))
    assert not different(task, 0.010, 0.0145) and different(task, 0.010, 0.016)  # dt is 50 ms
