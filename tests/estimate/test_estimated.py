"""The closed loop on estimated states: one run, and a shortened study with one seed."""

import json
from dataclasses import replace

import numpy as np
import pytest

from grounded.estimate import NoiseStd
from grounded.experiments import estimated
from grounded.experiments.car import real_case
from grounded.experiments.driving import markers
from grounded.experiments.estimated import Filmed
from grounded.search.first_policy import first_policy

NOISE = NoiseStd(np.array([0.047, 0.043, 1e-4, 2e-4, 2e-3, 1e-2]), np.full(4, 0.003), 1 / 30)


@pytest.fixture(scope="module")
def filmed():
    case = real_case("circle", 0, True)
    return Filmed(case.task, case.plant, markers(0.15), 0.003, NOISE)


@pytest.fixture(scope="module")
def policy(filmed):
    return first_policy(filmed.task)[0]


def test_a_run_comes_back_as_a_smoothed_trial_near_the_truth(filmed, policy):
    flown = filmed.run(policy, np.random.default_rng(1))
    task = filmed.task
    assert flown.trial.steps == flown.truth.steps == task.horizon
    assert np.array_equal(flown.trial.inputs, flown.truth.inputs)
    assert (np.abs(flown.trial.inputs) <= 1).all()
    smoothed, live = (
        np.sqrt(np.mean((x - flown.truth.states) ** 2, axis=0))
        for x in (flown.trial.states, flown.live)
    )
    assert (smoothed[2:4] < 0.003).all()  # better than a marker
    assert (smoothed[1:5] < live[1:5]).all()
    assert smoothed[1] < 0.05 and smoothed[4] < 0.02
    assert smoothed[5] < 0.5  # heading rate, not measured: known by kinematics
    assert 0.8 < flown.nis < 1.3
    assert task.utility(flown.trial) == pytest.approx(task.utility(flown.truth), rel=0.05)


def test_on_true_states_the_controller_sees_no_camera(filmed, policy):
    blind = replace(filmed, camera=np.nan)
    flown = blind.run(policy, np.random.default_rng(1), estimated=False)
    assert flown.trial is flown.truth and np.isnan(flown.nis)
    on_estimates = filmed.run(policy, np.random.default_rng(1)).truth
    better = filmed.task.utility(flown.truth)
    assert filmed.task.utility(on_estimates) < better < 0


def test_a_car_that_runs_away_ends_its_trial(filmed, policy):
    away = filmed.plant.model.with_values({"a2": 1e12, "tau_v": 1e-3})
    wild = replace(filmed, plant=replace(filmed.plant, model=away))
    flown = wild.run(policy, np.random.default_rng(1))
    assert flown.trial.steps < filmed.task.horizon
    assert np.isfinite(flown.trial.states).all()


@pytest.mark.slow
def test_the_search_learns_from_estimated_states(monkeypatch):
    for name, value in {"BUDGET": 4, "FRESH": 2, "NAMES": ("circle",)}.items():
        monkeypatch.setattr(estimated, name, value)
    monkeypatch.setattr(estimated, "DRIVING", 10.0)
    result = estimated.run([0], manoeuvres=("circle",))
    document = json.loads(json.dumps(result.to_json(), allow_nan=False))
    camera, true = (result.of("circle", way)[0] for way in estimated.WAYS)
    assert camera.improvement > 0.88 and true.improvement > 0.88  # the paper's
    assert camera.live[0] > camera.smoothed[0] and true.live is None
    assert document["paper"] == {"circle": 0.88}
    for table in result.tables():
        assert table.rows and all(len(row) == len(table.head) for row in table.rows)
