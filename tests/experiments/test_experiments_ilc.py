"""Norm-optimal ILC's lifted model, against the simulation that it linearises."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.experiments.bench import bench, many_runs, optimum, start_of
from grounded.experiments.ilc import gradient_of, lifted
from grounded.rollout import simulate
from grounded.search.first_policy import first_policy


@pytest.fixture(scope="module", params=["turn", "circle"])
def case(request):
    case = bench(request.param, "structural", 1)
    return case, first_policy(case.task)[0]


def test_the_lifted_model_is_the_models_derivative(case):
    case, policy = case
    inside = np.clip(policy.feedforward, -0.98, 0.98)
    policy = replace(policy, feedforward=inside, low=policy.low - 9, high=policy.high + 9)
    task = replace(case.task, low=case.task.low - 9, high=case.task.high + 9)
    model = lifted(task, policy)
    rng = np.random.default_rng(0)
    h = 1e-6 * rng.normal(size=policy.feedforward.shape)
    up = simulate(task.problem(), replace(policy, feedforward=inside + h))
    down = simulate(task.problem(), replace(policy, feedforward=inside - h))
    states = (model.states @ h.ravel(), (up.states - down.states) / 2)
    inputs = (model.inputs @ h.ravel(), (up.inputs - down.inputs) / 2)
    for found, expected in (states, inputs):
        assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()


def test_the_gradient_of_differences_is_the_real_one(case):
    case, policy = case
    policy = replace(policy, feedforward=np.clip(policy.feedforward, -0.9, 0.9))
    _, gradient = gradient_of(replace(case.truth, smoothing=0.0), policy)
    truth = case.truth.problem(exact=True)
    deep = policy.laid_out(policy.state_names, policy.angles, truth.depths)
    for t, j in ((5, 0), (20, 1)):
        step = np.zeros_like(policy.feedforward)
        step[t, j] = 1e-6
        up = simulate(truth, replace(deep, feedforward=deep.feedforward + step)).utility
        down = simulate(truth, replace(deep, feedforward=deep.feedforward - step)).utility
        assert (up - down) / 2e-6 == pytest.approx(gradient[t, j], rel=0.02, abs=1e-3)


def test_the_optimum_is_better_than_the_models_policy(case):
    case, policy = case
    _, best = optimum(case)
    assert best > case.task.utility(case.real(policy, 0))


def test_a_case_is_its_seed():
    a, b = bench("circle", "parametric", 4), bench("circle", "parametric", 4)
    assert (a.plant.model.values == b.plant.model.values).all()
    assert (a.plant.model.values != bench("circle", "parametric", 5).plant.model.values).any()


def test_many_runs_are_the_plants_runs():
    case = bench("circle", "noise", 2)
    policy, _ = first_policy(case.task)

    def streams():
        return [np.random.default_rng([2, i]) for i in range(3)]

    together = many_runs(case.task, case.plant, policy, streams())
    for trial, rng in zip(together, streams(), strict=True):
        alone = case.plant.run(policy, start_of(case.task), rng)
        assert np.abs(trial.states - alone.states).max() < 1e-7
        assert np.abs(trial.inputs - alone.inputs).max() < 1e-7
