"""A robot whose program acts on old samples runs new policies as predicted all the same."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.policy import z_difference
from grounded.rollout import for_late_samples, simulate
from grounded.search.feedback import sample_age
from grounded.search.improve import propose
from grounded.search.step_size import SearchOptions
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
