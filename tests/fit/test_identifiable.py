"""Constants never change; only uncertain parameters that the trials identify are written."""

import numpy as np
import pytest

from facts import holding, of_code
from grounded import Model, Param, Trial
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.validation.identifiable import identified
from grounded.effects import Library
from grounded.errors import GroundedError
from grounded.fit import fit


def motor(**params):
    return Model(
        states={"v": "m/s"},
        inputs={"u": "N"},
        params=params,
        derivative=lambda s, a, p: {"v": (p.gain * a.u - p.drag * s.v) / p.mass},
    )


def trials(count=3, mass=2.0, gain=3.0, drag=0.5, T=56):
    rng, found = np.random.default_rng(3), []
    for _ in range(count):
        u = np.repeat(rng.uniform(-1, 1, T // 8), 8)[:, None]
        v = np.zeros(T + 1)
        for k in range(T):
            v[k + 1] = v[k] + 0.05 * (gain * u[k, 0] - drag * v[k]) / mass
        noisy = (v + 1e-3 * rng.standard_normal(T + 1))[:, None]
        found.append(Trial(noisy, u, 0.05, ("v",), ("u",), start_inputs=np.zeros(1)))
    return found


@pytest.mark.slow
def test_a_constant_is_neither_fitted_nor_blamed_nor_calibrated():
    model = motor(mass=Param(2.0, "kg"), gain=Param(3.0), drag=Param(0.3, "N s/m", 0.0, 2.0))
    found = fit(model, trials())
    assert list(found.params) == ["drag"] and found.params["drag"].value == pytest.approx(0.5, 0.1)
    assert found.model.params["mass"] == model.params["mass"]
    with pytest.raises(GroundedError, match="'mass'"):
        fit(model, trials(), ["mass"])
    diagnosis = diagnose(model, trials())
    assert set(diagnosis.parameters) <= {"drag"}
    assert not {"parameter:mass", "parameter:gain"} & {row.effect for row in diagnosis.ranking}
    assert [one.parameter for one in diagnosis.identifiable] == ["drag"]
    constants = motor(mass=Param(2.0), gain=Param(3.0), drag=Param(0.3))
    with pytest.raises(GroundedError, match=holding(f"'{constants.name}'")):
        fit(constants, trials())


@pytest.mark.slow
def test_of_a_combination_the_surest_parameter_stays():
    """Only gain / mass and drag / mass are identified."""
    model = motor(
        mass=Param(2.0, "kg", std=0.1), gain=Param(2.5, std=0.5), drag=Param(0.4, std=0.2)
    )
    found = fit(model, trials())
    assert not found.params["mass"].identified and found.params["mass"].value == 2.0
    assert found.params["gain"].identified and found.params["gain"].value == pytest.approx(3, 0.03)
    assert found.params["gain"].only_with == found.params["drag"].only_with == ("mass",)
    (one,) = [one for one in found.findings if one.code == "model.given"]
    assert one.facts["rests"] == ("mass",)
    diagnosis = diagnose(model, trials())
    verdicts = {one.parameter: one.verdict for one in diagnosis.identifiable}
    assert verdicts["mass"] == "not identifiable"
    assert "mass" not in diagnosis.known_parameters


def test_a_parameter_that_is_found_off_is_identified_by_what_shows_that():
    model = motor(mass=Param(2.0), gain=Param(2.0, "1", 0.1, 20), drag=Param(0.5, "1", 0.05, 10))
    data = prepare(model, trials(), np.zeros(1))
    search = HypothesisSearch(data, Library().candidates(model, data.scales))
    search.nulls()
    off = Library().effect("parameter:gain", model, data.scales)
    start = search.fresh(Hypothesis(shift=np.zeros(3), spread=1.0).plus(off, {"d": 1.0}))
    (found, *_) = search.refined([start], 12)
    assert found.hypothesis.values[0]["d"] == pytest.approx(1.0, abs=0.1)
    verdicts = {
        one.parameter: one.verdict for one in identified(search.predictor, found).parameters
    }
    assert verdicts == {"gain": "identifiable", "drag": "identifiable"}


def drags(noise=0.02, T=80):
    """Make trials at speeds near 1, where two drags of 0.6 show nearly as one."""
    rng, found = np.random.default_rng(5), []
    for _ in range(4):
        u, v = np.repeat(rng.uniform(1.1, 1.3, T // 8), 8)[:, None], np.ones(T + 1)
        for k in range(T):
            x = v[k]
            for _ in range(10):
                x += 0.005 * (u[k, 0] - 0.6 * x - 0.6 * x * x)
            v[k + 1] = x
        noisy = (v + noise * rng.standard_normal(T + 1))[:, None]
        found.append(Trial(noisy, u, 0.05, ("v",), ("u",), start_inputs=np.zeros(1)))
    return found


def test_parameters_that_are_known_only_together_are_written_together():
    model = Model(
        states={"v": "m/s"},
        inputs={"u": "N"},
        params={"a": Param(0.5, std=0.1), "b": Param(0.5, std=0.1)},
        derivative=lambda s, a, p: {"v": a.u - p.a * s.v - p.b * s.v**2},
    )
    diagnosis = diagnose(
        model, drags(), DiagnosisOptions(library=Library((Library().family("offset"),)))
    )
    assert [c.of for c in diagnosis.credit] == ["calibration"]
    assert {i.verdict for i in diagnosis.identifiable} == {"not identifiable"}
    assert diagnosis.jointly == {"a", "b"} == set(diagnosis.known_parameters)
    total = sum(e.value for e in diagnosis.known_parameters.values())
    assert total == pytest.approx(1.2, abs=0.01)
    written = diagnosis.to_json()["identifiable"]
    assert all(one["jointly"] for one in written)
    (one,) = of_code(diagnosis, "model.given")
    assert one.about == ("a", "b")
