"""Whether trials agree in what is claimed, and what changed between two groups of them."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cli import grounded
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.parts import Diagnosis
from grounded.diagnosis.validation.ruler import repeated
from grounded.effects import Library
from small_tasks import pushed_cart

FEW = (
    *("coulomb_friction", "viscous_friction", "dead_zone"),
    *("input_gain", "delay", "offset", "trend"),
)


def codes(found):
    return {one.code for one in found.findings}


OPTIONS = DiagnosisOptions(library=Library(tuple(map(Library().family, FEW))))


@pytest.mark.slow
def test_a_value_that_differs_by_trial_is_told():
    trials = [pushed_cart(friction=0.25 + 0.05 * k, trials=1, seed=k)[1][0] for k in range(6)]
    found = diagnose(pushed_cart()[0], trials, OPTIONS)
    (one,) = (a for a in found.agreement if a.effect == "coulomb_friction:v")
    assert not one.agrees
    values = [v.value for v in found.per_trial if v.effect == one.effect]
    assert np.polyfit(np.arange(6), values, 1)[0] == pytest.approx(0.05, rel=0.25)
    assert "gap.disagree" in codes(found)


@pytest.mark.slow
def test_what_changed_between_two_groups():
    model, before = pushed_cart(friction=0.3, trials=2, seed=1)
    _, after = pushed_cart(friction=0.5, trials=2, seed=2)
    found = diagnose(model, before, OPTIONS, compare=after)
    assert found.trials == 4 and found.changed is not None
    (one,) = found.changed
    assert one.effect == "coulomb_friction:v"
    assert {"gap.next.changed", "gap.changed"} <= {*codes(found)}
    assert (one.first.value, one.second.value) == pytest.approx((0.3, 0.5), abs=0.06)
    assert one.evidence > 20 and one.chance < 1e-6
    assert abs(one.first.value - one.second.value) > 3 * np.hypot(one.first.std, one.second.std)
    again = Diagnosis.from_json(json.loads(json.dumps(found.to_json())))
    assert again == found and again.changed == found.changed


def test_groups_that_overlap_are_refused(workspace_of):
    folder = workspace_of().folder
    done = grounded("-C", folder, "diagnose", "--compare", "t0001,t0002", "t0002")
    assert done.code == 1 and "--compare" in done.err


def test_trials_of_two_groups_are_no_repeats():
    _, trials = pushed_cart(trials=1)
    trials = [replace(trials[0], candidate="c0001")] * 4
    data = SimpleNamespace(lengths=np.array([trial.steps for trial in trials]))
    assert repeated(trials, data, 4) == [[0, 1, 2, 3]]
    assert repeated(trials, data, 2) == [[0, 1], [2, 3]]
    assert repeated(trials[:2], data, 1) == []
    same = [replace(trial, candidate="") for trial in trials]
    assert repeated(same, data, 2) == [[0, 1], [2, 3]]
