"""What of the error is noise."""

from dataclasses import replace

import numpy as np

from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.effects import Library
from small_tasks import DT, pushed_cart


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


def test_without_an_effect_the_error_is_noise():
    model, trials = pushed_cart()
    found = diagnose(model, trials)
    for row in found.prediction_error[:-1]:
        assert row.with_effects == row.crude and row.floor_from == "short horizon"
        assert all(e < 1.1 * row.noise_floor[name] for name, e in row.crude.items())
    where = found.to_json()["where"]  # shares of noise would differ from day to day
    assert found.kind == "none" and where["times"] == where["regions"] == []
    assert {c["share"] for c in where["channels"]} == {None}


def test_repeats_of_a_candidate_tell_the_noise():
    model, trials = pushed_cart(trials=1)
    same = repeats_of(trials[0], 4)
    for row in diagnose(model, same).prediction_error[:-1]:
        assert row.floor_from == "repeats"
        assert all(e < 1.2 * row.noise_floor[name] for name, e in row.with_effects.items())


def test_a_trial_beside_itself_confirms_nothing():
    model, trials = pushed_cart(friction=0.4, trials=1)
    few = DiagnosisOptions(library=Library((Library().family("coulomb_friction"),)))
    found = diagnose(model, [trials[0], trials[0]], few)
    assert found.no_cause and not found.effects and found.trials == 1
