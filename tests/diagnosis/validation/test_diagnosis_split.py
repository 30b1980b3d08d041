"""What the error is made of, and how well utilities are predicted."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.error_report import Split
from grounded.diagnosis.likelihood.noise import DOF, NoiseModel, Structure
from grounded.diagnosis.pictures import where_figure
from grounded.diagnosis.validation.measured import shares, split
from grounded.effects import Library
from small_tasks import DT, pushed_cart, pushed_cart_task

HORIZONS = ("one_step", "horizon", "whole_run")


def parts(row):
    return [row[key] for key in ("explained", "unexplained", "irreducible")]


def repeats_of(trial, count):
    """The same commands again, other noise."""
    noise, same = np.random.default_rng(3), []
    for _ in range(count):
        x, states = np.zeros(2), [np.zeros(2)]
        for value in trial.inputs[:, 0]:
            for _ in range(10):
                x = x + DT / 10 * np.array([x[1], 2.0 * value - x[1]])
            x = x + np.array([0.0003, 0.003]) * noise.standard_normal(2)
            states.append(x)
        y = np.array(states) + np.array([0.002, 0.01]) * noise.standard_normal((121, 2))
        same.append(replace(trial, states=y, candidate="c0001"))
    return same


@pytest.mark.slow
def test_an_effect_that_is_found_explains_the_error():
    model, trials = pushed_cart(friction=0.4)
    document = diagnose(pushed_cart_task(model), trials).to_json()
    split = document["where"]["split"]
    assert tuple(split) == HORIZONS
    for row in split.values():
        for one in (row["all"], *row["channels"]):
            assert sum(parts(one)) == pytest.approx(1)
            assert min(parts(one)) >= 0
    assert split["horizon"]["all"]["explained"] > 0.98
    assert split["one_step"]["channels"][0]["irreducible"] > 0.8  # of x: one step is mostly noise
    assert split["whole_run"]["horizon_s"] > 5
    assert min(document["where"]["whiteness"].values()) > 0.01
    utility = document["utility_prediction"]
    assert utility["trials"] == 4
    assert utility["after"] < 0.1 * utility["before"]


def test_without_an_effect_the_error_is_noise():
    model, trials = pushed_cart()
    found = diagnose(model, trials)
    row = found.where.split["horizon"]
    assert row.whole.explained == 0
    assert row.whole.irreducible > 0.85
    assert row.irreducible_from == "noise"
    assert found.utility_prediction is None
    where = found.to_json()["where"]  # shares of noise would differ from day to day
    assert found.kind == "none" and where["times"] == where["regions"] == []
    assert {c["share"] for c in where["channels"]} == {None}
    assert where_figure(found) is None or "channel" not in str(where_figure(found).panels[0].title)


def test_what_no_effect_explains_stays_unexplained_and_is_not_white():
    model, trials = pushed_cart(asymmetric=0.8, trials=6)
    poor = DiagnosisOptions(
        library=Library((Library().family("trend"),))
    )  # nothing that could explain it
    found = diagnose(pushed_cart_task(model), trials, poor)
    assert found.leftover and found.where.whiteness["v"] < 0.01
    assert found.where.split["horizon"].channels[1].explained < 1


def test_repeats_of_a_candidate_tell_the_noise():
    model, trials = pushed_cart(trials=1)
    same = repeats_of(trials[0], 4)
    row = diagnose(model, same).where.split["horizon"]
    assert row.irreducible_from == "repeats"
    assert row.whole.irreducible > 0.7


def test_of_a_noise_that_is_not_known_no_share_is_told():
    before, after = np.array([1.0, 2.0]), np.array([0.5, 2.0])
    row = split(3.4, {"x": "m", "v": "m/s"}, before, after, np.array([0.2, np.nan]), "repeats", 1.0)
    assert row.whole.explained == pytest.approx((1 - 0.25 + 0) / 2)
    assert np.isnan([row.whole.unexplained, row.whole.irreducible]).all()
    x, v = row.channels
    assert x.unexplained + x.irreducible == pytest.approx(0.25) and v.explained == 0
    assert np.isnan([v.unexplained, v.irreducible]).all() and not row.may_be_noise(v)
    assert row.may_be_noise(x) and not replace(row, irreducible_unsure=0.1).may_be_noise(x)
    assert Split.from_json(row.to_json()) == row


def test_shares_are_of_what_there_was():
    before, after, noise = np.array([4.0, 1.0]), np.array([1.0, 2.0]), np.array([0.5, 0.4])
    found = shares(before, after, noise)
    np.testing.assert_allclose(found[:, 0], [0.75, 0.125, 0.125])
    np.testing.assert_allclose(found[:, 1], [0.0, 0.6, 0.4])
    by_trials = shares(before, after, np.array([1.0, 0.4]))
    np.testing.assert_allclose(by_trials[:, 0], [0.75, 0.0, 0.25])


def test_noise_with_its_outliers_comes_to_its_variance():
    rng, n = np.random.default_rng(0), 1
    v = rng.standard_t(3, (2000, 3, n))
    r, weight = 1.0, np.ones_like(v)
    for _ in range(20):  # Student of 4 degrees of freedom, by expectation and maximisation
        weight = (DOF + 1) / (DOF + v**2 / r)
        r = float((weight * v**2).mean())
    logs = np.full(n, np.log(r))
    noise = NoiseModel(Structure(), logs, logs, logs, logs - 20, weight, weight)
    assert noise.plain.measurement(1)[0, 0, 0] == pytest.approx((v**2).mean(), rel=0.05)
    assert r < 0.6 * (v**2).mean() and noise.plain.weight_v == 1.0


def test_a_copy_counts_once():
    model, trials = pushed_cart(trials=1)
    same = [replace(t, id=f"t{k}") for k, t in enumerate(repeats_of(trials[0], 3))]
    alone, beside = diagnose(model, same), diagnose(model, [*same, replace(same[0], id="t9")])
    assert (beside.trials, beside.kind) == (3, alone.kind) and not beside.leftover
    assert beside.prediction_error[-1].noise_floor == alone.prediction_error[-1].noise_floor
    (one,) = [one for one in beside.findings if one.code == "model.copy"]
    assert one.about == ("t9",) and one.facts["first"] == "t0"


def test_a_trial_beside_itself_confirms_nothing():
    model, trials = pushed_cart(friction=0.4, trials=1)
    few = DiagnosisOptions(library=Library((Library().family("coulomb_friction"),)))
    found = diagnose(model, [trials[0], trials[0]], few)
    assert found.no_cause and not found.effects and found.trials == 1


@pytest.mark.slow
def test_without_repeats_noise_is_a_bound_unless_what_is_left_is_white():
    model, trials = pushed_cart(asymmetric=0.8, trials=4)
    poor = DiagnosisOptions(library=Library((Library().family("trend"),)))
    found = diagnose(model, trials, poor)
    assert all(row.floor_at_most for row in found.prediction_error)
    assert found.leftover[0].floor_at_most
    assert found.where.split["horizon"].irreducible_from == "at most"
    white = diagnose(*pushed_cart())
    assert not any(row.floor_at_most for row in white.prediction_error)
    assert white.kind == "none"
