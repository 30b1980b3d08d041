"""A parameter that is known only together with one that is held says so."""

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.effects import Library

DT = 0.05
TRUE = {"m": 1.25, "k": 1.5, "b": 0.6}  # in the model: 1, 1, 0.5


def motor(trials=3):
    """A cart that only tells k / m, and b; the crude model is sure of m to 20 %."""
    model = Model(
        states={"v": "m/s"},
        inputs={"u": "V"},
        params={
            "m": Param(1.0, "kg", std=0.2),
            "k": Param(1.0, "N/V", std=0.5),
            "b": Param(0.5, "1/s", std=0.3),
        },
        derivative=lambda s, a, p: {"v": p.k / p.m * a.u - p.b * s.v},
        name="motor",
    )
    rng, found = np.random.default_rng(0), []
    for _ in range(trials):
        u = np.sin(rng.uniform(1, 4) * np.arange(150) * DT)[:, None]
        y = [np.zeros(1)]
        for value in u:
            real = np.array([TRUE[name] for name in model.param_names])
            y.append(model.system.step(y[-1][None], value[None], real, DT)[0])
        states = np.array(y) + 3e-3 * rng.standard_normal((151, 1))
        found.append(Trial(states, u, DT, ("v",), ("u",), start_inputs=np.zeros(1)))
    return model, found


@pytest.fixture(scope="module")
def found():
    model, trials = motor()
    alone = DiagnosisOptions(library=Library(()))  # calibration alone
    return diagnose(model, trials, alone)


def test_a_gain_follows_the_mass_that_is_held(found):
    by = {one.parameter: one for one in found.identifiable}
    assert by["k"].given == pytest.approx({"m": 1.0}, abs=0.1) and not by["b"].given
    assert found.parameters["k"].value == pytest.approx(TRUE["k"] / TRUE["m"], rel=0.02)
    off = TRUE["k"] - found.parameters["k"].value
    assert abs(off) > 5 * found.parameters["k"].std  # with m as written
    assert abs(off) < 2 * by["k"].prior * by["k"].left  # with all free
    (one,) = [f for f in found.findings if f.code == "model.given"]
    assert one.about == ("k",) and one.facts["rests"] == ("m",)
