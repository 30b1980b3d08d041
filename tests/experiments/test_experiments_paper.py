"""The paper's studies on few seeds: what they must show, as plain and repeatable data."""

import json

import numpy as np
import pytest

from grounded.experiments import (
    baselines,
    car,
    flight,
    footnote9,
    nondeterminism,
    repeats,
    theorem1,
)


def plain(result):
    """The JSON document, which must be one: no NaN, no arrays."""
    text = json.dumps(result.to_json(), allow_nan=False)
    for table in result.tables():
        assert all(len(row) == len(table.head) for row in table.rows)
    return json.loads(text)


@pytest.fixture(scope="module")
def jobs():
    """What the flights of `flown` gave, by job."""
    return {}


@pytest.fixture(scope="module")
def flown(jobs):
    return flight.run(2, finished=jobs)


def test_the_aircraft_ends_within_two_per_cent_of_the_optimum(flown):
    for run in flown.flown:
        assert len(run.utilities) <= 1 + flight.ITERATIONS
        assert run.utilities[-1] >= 1.02 * flown.optimum
        assert list(run.utilities) == sorted(run.utilities)
        assert run.improvement > 0.7
    assert flown.optimum == pytest.approx(-1826, abs=2)


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
    shown = document["figure"]
    assert len(shown["desired"]) == len(shown["model"]) == len(shown["learned"]) == 601
    error = np.abs(np.array(shown["learned"]) - shown["desired"]).max(axis=0)
    assert error[2] < 1.0  # altitude [m], what the model-based controller can't hold


@pytest.mark.slow
def test_flights_can_be_continued(flown, jobs):
    kept = dict(list(jobs.items())[:1])
    plain(flight.run(1, finished=kept))  # one run has no standard error: null, not NaN
    again = flight.run(2, finished=kept)
    assert len(kept) == 2
    assert again.to_json() == flown.to_json()


def test_an_unstable_first_controller_is_discarded(monkeypatch):
    monkeypatch.setattr(flight, "RADIUS", 1.0)
    result = flight.flight_job(0, "damped")
    assert result["discarded"] and result["trials"] == 1
    assert result["utilities"][0] < -5000


def test_footnote9_is_solved_in_one_iteration():
    document = plain(footnote9.run((1.0, 5.0, 30.0)))
    for row in document["rows"]:
        assert row["solved"] == pytest.approx(1.0, abs=1e-9)
        assert row["solved_trials"] == 2
    assert document["rows"][1]["gradient"] < 1e-9  # a single gradient step never gets there
    assert document["rows"][2]["model_based"] == 0.0


@pytest.mark.slow
def test_theorem1_has_its_slopes_and_keeps_its_bound():
    result = theorem1.run(range(2), epsilons=(0.003, 0.03, 0.1))
    document = plain(result)
    assert document["slopes"]["gradient_error"]["slope"] == pytest.approx(1.0, abs=0.1)
    assert document["slopes"]["squared_gradient"]["slope"] == pytest.approx(2.0, abs=0.2)
    assert document["largest_ratio_to_bound"] <= 1.0
    known = document["K"]
    assert known["measured"] == max(row["K"] for row in document["rows"])
    assert all(row["K"] <= row["proof_K"] <= known["proof"] for row in document["rows"])
    assert known["proof"] < 1e4  # far above what is measured, but no void statement


def test_the_model_of_theorem1_is_wrong_by_epsilon():
    task = theorem1.theorem1_task(0.1, 0)
    truth = task.model.with_values({"eps": 0.0})
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(200, 2)), rng.normal(size=(200, 1))
    f_x, f_u = task.model.system.linearise(x, u, task.model.values, 0.1)
    t_x, t_u = truth.system.linearise(x, u, truth.values, 0.1)
    assert np.linalg.norm(f_x - t_x, axis=(1, 2)).max() < 0.11 * 0.1
    assert np.linalg.norm(f_u - t_u, axis=(1, 2)).max() < 0.11 * 0.1


def test_end_points_spread_as_the_paper_says():
    result = nondeterminism.run(5, levels=(0.0, 1.0, 3.0))
    document = plain(result)
    by_level = {
        level: [s["largest"] for s in document["spreads"] if s["level"] == level]
        for level in (0.0, 1.0, 3.0)
    }
    assert max(by_level[0.0]) == 0.0
    assert min(by_level[1.0]) > 0.01 and max(by_level[3.0]) < 0.5


@pytest.mark.slow
def test_the_quiet_car_reaches_the_papers_improvement():
    result = car.run([], manoeuvres=("turn",))  # the others: tests/search/test_improve.py
    (quiet,) = result.of("turn", False)
    assert quiet.improvement >= car.PAPER["turn"]
    assert quiet.trials <= car.BUDGET
    assert len(quiet.paths["target"]) == len(quiet.paths["iteration 0"])
    plain(result)


@pytest.mark.slow
def test_baselines_count_trials():
    result = baselines.run(
        [0], manoeuvres=("turn",), kinds=("parametric",), methods=("grounded", "ilc", "differences")
    )
    found = {line.method: line for line in result.lines}
    assert found["grounded"].final > 0.95 and found["ilc"].final > 0.95
    assert found["grounded"].trials[0] <= 4
    assert found["differences"].trials[0] > 100  # a gradient alone costs H m = 120 trials
    plain(result)
    assert baselines.median_trials([2, None, 4]) == "4"
    assert baselines.median_trials([2, None, None]) == "-"


@pytest.mark.slow
def test_noise_judges_by_fresh_runs():
    rules = (repeats.RULES[0], repeats.RULES[5])
    result = repeats.run([0], manoeuvres=("turn",), levels=(1.0,), rules=rules)
    document = plain(result)
    assert [o["rule"] for o in document["outcomes"]] == [rule.name for rule in rules]
    assert all(o["closed"] > 0.8 for o in document["outcomes"])
    assert document["recommended"] in [rule.name for rule in rules]
    assert result.tables()[-1].rows[0][-1] == f"{document['outcomes'][0]['trials']:.1f}"


def test_the_recommended_rule_is_the_cheapest_that_is_as_good_as_the_best():
    def outcome(rule, seed, closed, trials):
        return repeats.Outcome(rule, "turn", 1.0, seed, 5, 1, closed, closed, 0.0, trials)

    lucky = [outcome("dear", s, 0.99 + 0.01 * (-1) ** s, 40) for s in range(8)]
    cheap = [outcome("cheap", s, 0.988 - 0.01 * (-1) ** s, 20) for s in range(8)]
    bad = [outcome("bad", s, 0.8, 5) for s in range(8)]
    assert repeats.NoiseResult((*lucky, *cheap, *bad)).recommended == "cheap"
    worse = [outcome("cheap", s, 0.9, 20) for s in range(8)]
    assert repeats.NoiseResult((*lucky, *worse, *bad)).recommended == "dear"
