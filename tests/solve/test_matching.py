"""Matched inputs: the model still replays the trial, and is asked where it agrees with it."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.experiments.car_tasks import car_task
from grounded.experiments.real_car import real_plant
from grounded.models.car import model as car
from grounded.search.first_policy import first_policy
from grounded.solve.bias import ground
from grounded.solve.levenberg_marquardt import LeastSquares, solve


@pytest.fixture(scope="module")
def trial():
    task = car_task("circle", car)
    policy, _ = first_policy(task)
    start = dict(zip(car.state_names, task.start, strict=True))
    return task, policy, real_plant().run(policy, start, np.random.default_rng(0))


@pytest.mark.parametrize("exact", [True, False])
def test_the_model_with_matched_inputs_replays_the_trial(trial, exact):
    task, policy, run = trial
    grounding = ground(task, run, exact=exact, match_inputs=True)
    problem = grounding.on(task.problem(exact=exact))
    assert np.abs(grounding.shift).max() > 0.01
    swarm = problem.system.rollout(problem, policy.feedforward, policy.gain, policy.reference)
    np.testing.assert_allclose(swarm.z[0][:, : car.n], run.states, atol=1e-9)
    np.testing.assert_allclose(swarm.u[0], run.inputs, atol=1e-9)


def test_matched_inputs_leave_less_to_the_bias(trial):
    task, _, run = trial
    plain = ground(task, run, exact=True).bias
    matched = ground(task, run, exact=True, match_inputs=True).bias
    speed = car.state_names.index("v")
    assert np.abs(matched[20:, speed]).mean() < 0.2 * np.abs(plain[20:, speed]).mean()


def test_a_model_that_is_right_needs_no_shift(trial):
    task, policy, _ = trial
    from grounded.plant import Plant

    plant = Plant(car, latency=dict.fromkeys(car.input_names, 0.1), substeps=1)
    start = dict(zip(car.state_names, task.start, strict=True))
    run = plant.run(policy, start, np.random.default_rng(0))
    still = replace(task, smoothing=0.0)
    assert np.abs(ground(still, run, match_inputs=True).shift).max() < 1e-6


def test_levenberg_marquardt_solves_each_row_and_keeps_bounds():
    goals = np.array([[0.5, -0.2], [3.0, 0.1], [-0.9, 0.7]])

    def residual(w, rows):
        return np.column_stack([w[:, 0] ** 3 + w[:, 1], w[:, 1]]) - np.column_stack(
            [goals[rows, 0] ** 3 + goals[rows, 1], goals[rows, 1]]
        )

    def jacobian(w, rows):
        J = np.zeros((len(w), 2, 2))
        J[:, 0, 0], J[:, 0, 1], J[:, 1, 1] = 3 * w[:, 0] ** 2, 1.0, 1.0
        return J

    bounds = np.array([1.0, 1.0])
    batch = LeastSquares(residual, jacobian, -bounds, bounds, solved=1e-20)
    found = solve(batch, np.full((3, 2), 0.3), np.arange(3), 60)
    np.testing.assert_allclose(found.w[[0, 2]], goals[[0, 2]], atol=1e-6)
    assert found.w[1, 0] == 1.0 and found.error[1] > 1.0
