"""The paper's studies on few seeds: what they must show, as plain and repeatable data."""

import json

import numpy as np
import pytest

from grounded.experiments import car, flight, theory


def plain(result):
    """The JSON document, which must be one: no NaN, no arrays."""
    text = json.dumps(result.to_json(), allow_nan=False)
    for table in result.tables():
        assert all(len(row) == len(table.head) for row in table.rows)
    return json.loads(text)


@pytest.fixture(scope="module")
def flown():
    return flight.run(1)


def test_the_aircraft_ends_within_two_per_cent_of_the_optimum(flown):
    document = plain(flown)
    for run in document["runs"]:
        assert len(run["utilities"]) <= 1 + flight.ITERATIONS
        assert run["utilities"][-1] >= 1.02 * run["optimum"]
        assert run["utilities"] == sorted(run["utilities"])
    assert document["improvement"]["mean"] > 0.7
    assert document["optimum"] == pytest.approx(-1826, abs=2)


def test_flight_speaks_the_contract(flown):
    document = plain(flown)
    assert set(document["runs"][0]) == {
        "seed",
        "discarded",
        "utilities",
        "trials",
        "alphas",
        "optimum",
    }
    assert set(document["improvement"]) == {"mean", "se", "ratio_of_means"}


def test_an_unstable_first_controller_is_discarded(monkeypatch):
    monkeypatch.setattr(flight, "RADIUS", 1.0)
    result = flight.flight_job(0)
    assert result["discarded"] and result["trials"] == 1
    assert result["utilities"][0] < -5000


def test_footnote9_is_solved_in_one_iteration():
    document = plain(theory.footnote9((1.0, 5.0, 30.0)))
    for row in document["rows"]:
        assert row["solved"] == pytest.approx(1.0, abs=1e-9)
        assert row["solved_trials"] == 2
    assert document["rows"][2]["model_based"] == 0.0


@pytest.mark.slow
def test_theorem1_has_its_slopes_and_keeps_its_bound():
    result = theory.theorem1(range(1), epsilons=(0.01, 0.1))
    document = plain(result)
    assert document["slopes"]["gradient_error"]["slope"] == pytest.approx(1.0, abs=0.1)
    assert document["slopes"]["squared_gradient"]["slope"] == pytest.approx(2.0, abs=0.2)
    assert document["largest_ratio_to_bound"] <= 1.0
    assert document["K"] == max(row["K"] for row in document["rows"])


def test_the_model_of_theorem1_is_wrong_by_epsilon():
    task = theory.theorem1_task(0.1, 0)
    truth = task.model.with_values({"eps": 0.0})
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(200, 2)), rng.normal(size=(200, 1))
    f_x, f_u = task.model.system.linearise(x, u, task.model.values, 0.1)
    t_x, t_u = truth.system.linearise(x, u, truth.values, 0.1)
    assert np.linalg.norm(f_x - t_x, axis=(1, 2)).max() < 0.11 * 0.1
    assert np.linalg.norm(f_u - t_u, axis=(1, 2)).max() < 0.11 * 0.1


def test_the_car_learns_its_turn_though_its_runs_scatter():
    result = car.run((0,), manoeuvres=("turn",))
    document = plain(result)
    for run in document["runs"]:  # without scatter, and with it
        first = run["true"][0]
        assert 0.97 < run["improvement"] <= (run["optimum"] - first) / -first + 0.005
    assert document["runs"][0]["improvement"] == pytest.approx(0.989, abs=0.002)
    assert {run["noisy"] for run in document["runs"]} == {False, True}
