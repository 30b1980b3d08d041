"""The short version of `grounded experiment fit-car`: one car, two minutes of driving."""

import numpy as np
import pytest

from grounded.experiments.driving import drive
from grounded.experiments.fit_car import bench_angles, first_values, fit_car, true_car


@pytest.fixture(scope="module")
def found():
    return fit_car([3], minutes=2.0)


@pytest.mark.slow
def test_the_car_is_recovered_from_what_the_camera_saw(found):
    (run,) = found.runs
    assert run["status"].startswith("converged")
    for name, p in run["params"].items():
        if name == "stall":  # two minutes hardly visit it
            continue
        assert abs(p["value"] - p["true"]) < 4 * p["std"], name
        assert abs(p["value"] - p["true"]) < 0.15 * max(abs(p["true"]), 0.05), name
    assert sum(p["inside"] for p in run["params"].values()) >= 8


@pytest.mark.slow
def test_the_result_is_plain_and_makes_a_table(found):
    plain = found.to_json()
    assert set(plain["coverage"]) == set(found.runs[0]["params"])
    assert 0 <= plain["coverage_all"] <= 1
    (table,) = found.tables()
    assert len(table.rows) == 10
    assert all(len(row) == len(table.head) for row in table.rows)


def test_first_values_are_within_reach():
    rng = np.random.default_rng(5)
    truth, latency = true_car(rng)
    films = drive(truth, latency, 4.0, rng)
    first = first_values(films, truth.params["L"].value, bench_angles(truth, rng))
    for name, share in (
        ("a1", 0.05),
        ("a2", 0.15),
        ("a4", 0.3),
        ("stall", 0.3),
        ("tau_delta", 0.5),
    ):
        true = truth.params[name].value
        assert first[name] == pytest.approx(true, rel=share), name
    assert abs(first["latency"] - latency) < 0.05
