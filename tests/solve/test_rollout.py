"""Rollout: a simulated run is what the runner would do, step by step, in the model."""

import numpy as np
import pytest

from grounded.onboard import Runner
from grounded.plant import Plant
from grounded.rollout import augmented, simulate
from small_tasks import cart_task, rover, rover_task


def feedback_policy(task, seed=0):
    problem, rng = task.problem(), np.random.default_rng(seed)
    H, m, nz = task.horizon, task.model.m, problem.nz
    low, high = np.maximum(task.low, -1), np.minimum(task.high, 1)
    return task.policy(
        rng.uniform(low, high, (H, m)),
        0.2 * rng.normal(size=(H, m, nz)),
        rng.normal(size=(H, nz)),
    )


@pytest.mark.parametrize("delay", [0.0, 0.5, 1.0, 1.3, 2.0])
def test_a_rollout_is_the_runner_in_the_model(delay):
    task = rover_task(latency=np.array([delay * 0.05, 0.02]))
    policy = feedback_policy(task)
    run = simulate(task.problem(exact=True), policy)
    runner, x = Runner(policy), task.start
    sent = [task.past, task.past, task.past]
    for t in range(task.horizon):
        np.testing.assert_allclose(run.states[t], x, atol=1e-10)
        u = runner.action(t * task.dt, x)
        np.testing.assert_allclose(run.inputs[t], u, atol=1e-9)
        sent.append(u)
        received = []
        for j, d in enumerate(task.latency / task.dt):
            whole, part = int(d), d - int(d)
            older = sent[-2 - whole][j]
            received.append((1 - part) * sent[-1 - whole][j] + part * older)
        x = rover.system.step(x[None], np.array([received]), rover.values, task.dt)[0]
    np.testing.assert_allclose(run.states[-1], x, atol=1e-10)


def test_inputs_stay_inside_the_limits():
    task = rover_task(low=np.array([-0.1, -0.2]), high=np.array([0.1, 0.2]), past=np.zeros(2))
    run = simulate(task.problem(), feedback_policy(task))
    assert (run.inputs >= task.low).all() and (run.inputs <= task.high).all()


def test_a_run_that_diverges_is_minus_infinity_and_no_exception():
    task = cart_task()
    problem = task.problem(np.full((40, 2), 1e308))
    run = simulate(problem, task.policy(np.zeros((40, 1)), None, None))
    assert run.utility == -np.inf


def test_the_inputs_already_sent_stand_beside_the_states():
    task = rover_task(latency=np.array([0.0, 0.15]))
    problem = task.problem()
    u = np.arange(8.0).reshape(4, 2)
    z = augmented(problem, np.zeros((5, 3)), u, np.array([-1.0, -2.0]))
    np.testing.assert_array_equal(z[:, 3], [-1, 0, 2, 4, 6])
    np.testing.assert_array_equal(
        z[:, 4:], [[-2, -2, -2], [1, -2, -2], [3, 1, -2], [5, 3, 1], [7, 5, 3]]
    )


def test_smoothing_never_reaches_the_exact_model():
    """Just below the dead zone the exact model stands still; the smoothed one creeps."""
    task = rover_task(latency=np.zeros(2), past=np.array([0.04, 0.0]))
    policy = task.policy(np.tile([0.04, 0.0], (60, 1)), None, None)
    assert simulate(task.problem(exact=True), policy).states[-1, 0] == 0.0
    assert simulate(task.problem(), policy).states[-1, 0] > 1e-3


def test_the_plant_with_the_models_own_latency_is_the_model():
    task = rover_task(latency=np.array([0.05, 0.10]))
    policy = feedback_policy(task)
    run = simulate(task.problem(exact=True), policy)
    plant = Plant(rover, latency={"speed": 0.05, "turn": 0.10}, substeps=1)
    trial = plant.run(policy, {}, np.random.default_rng(0))
    np.testing.assert_allclose(trial.states, run.states, atol=1e-9)
    np.testing.assert_allclose(trial.inputs, run.inputs, atol=1e-9)
