"""Values that only priors set are as uncertain as these, and named with what they rest on."""

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.hypotheses.search import TO_THE_TOP, HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.validation.identifiable import identified
from grounded.effects import Library, wrap

DT = 0.05
OF_CART = DiagnosisOptions(library=Library((Library().family("input_gain"),)))


def cart(drag, std=0.05):
    """A cart whose force and mass show only as a ratio, unless it has a drag that is known."""
    return Model(
        states={"v": "m/s"},
        inputs={"u": "N"},
        params={"m": Param(2.0, "kg", std=std)},
        derivative=lambda s, a, p: {"v": (a.u - drag * s.v) / p.m},
    )


def driven(model, count=4, T=80, noise=1e-3, size=4.0):
    rng, found = np.random.default_rng(3), []
    for _ in range(count):
        u = np.repeat(rng.uniform(-size, size, (T // 8, model.m)), 8, axis=0)
        x = [np.zeros(model.n)]
        for row in u:
            x.append(model.system.step(x[-1][None], row[None], model.values, DT)[0])
        y = np.array(x) + noise * rng.standard_normal((len(x), model.n))
        found.append(
            Trial(y, u, DT, model.state_names, model.input_names, start_inputs=np.zeros(model.m))
        )
    return found


def weaker(model):
    return wrap(Library().effect("input_gain:u", model), {"g": -0.3}, DT)


def test_a_gain_beside_an_uncertain_mass_is_as_uncertain_as_the_mass():
    found = diagnose(cart(0.0), driven(weaker(cart(0.0))), OF_CART)
    assert found.effects == ("input_gain:u",)
    g = found.ranking[0].params["g"]
    assert g.value == pytest.approx(-0.3, abs=0.01)
    assert g.std == pytest.approx(0.7 * 0.05 / 2.0, rel=0.1)
    assert g.interval[1] - g.interval[0] > 3.8 * g.std
    (one,) = found.combinations
    assert one.values == ("input_gain:u",) and one.rests_on == {"m": 0.05}
    (told,) = [one for one in found.findings if one.code == "model.given"]
    assert told.about == ("input_gain:u",) and told.facts["rests"] == ("m",)
    assert found.to_json()["combinations"] == [
        {"values": ["input_gain:u"], "rests_on": {"m": 0.05}}
    ]


def planar(gravity=0.0):
    """Two joints in a horizontal plane: all torques and inertias may be larger by one factor."""

    def rates(s, a, p):
        mc, h = p.I2 + 0.06 * p.load, 0.07 + 0.075 * p.load
        c, sn = np.cos(s.q2), np.sin(s.q2)
        M11, M12 = 0.2 + p.I1 + 0.09 * p.load + mc + 2 * h * c, mc + h * c
        r1 = a.t1 + h * sn * (2 * s.w1 * s.w2 + s.w2**2) - gravity * np.sin(s.q1)
        r2, det = a.t2 - h * sn * s.w1**2, M11 * mc - M12**2
        w1, w2 = (mc * r1 - M12 * r2) / det, (M11 * r2 - M12 * r1) / det
        return {"q1": s.w1, "q2": s.w2, "w1": w1, "w2": w2}

    return Model(
        states={"q1": "rad", "q2": "rad", "w1": "rad/s", "w2": "rad/s"},
        inputs={"t1": "N m", "t2": "N m"},
        params={
            "I1": Param(0.045, "kg m^2", std=0.01),
            "I2": Param(0.05, "kg m^2", std=0.05),
            "load": Param(0.5, "kg", std=0.3),
        },
        derivative=rates,
    )


PLANAR = {
    "input_gain:t1+t2": {"g": -0.2},
    "joint_friction:t1<-w1": {"c": 0.2, "b": 0.3},
    "added_inertia:t2<-w2": {"J": 0.03},
}


def fitted(model):
    """Return what only priors set beside three effects, and the fit of these."""
    real = model
    for name in ("added_inertia:t2<-w2", "joint_friction:t1<-w1", "input_gain:t1+t2"):
        real = wrap(Library().effect(name, real), PLANAR[name], DT)
    data = prepare(model, driven(real, size=2.0))
    h = Hypothesis(shift=np.zeros(model.system.k), spread=1.0)
    for name, values in PLANAR.items():
        h = h.plus(Library().effect(name, model, data.scales), values)
    search = HypothesisSearch(data, ())
    (fit,) = search.refined([search.fresh(h)], TO_THE_TOP)
    return identified(search.predictor, fit), fit


def test_the_scale_of_a_planar_arm_rests_on_the_surest_inertia():
    found, fit = fitted(planar())
    (one,) = found.combinations
    assert {*one.values} == {*PLANAR, "load"} and one.rests_on == {"I1": 0.01}
    g = fit.hypothesis.values[0]["g"]
    # I1 + 0.2 + 0.09 load is in proportion to the torques, and so is 0.07 + 0.075 load
    per_g = (0.245 + 0.09 * 0.5 - 0.09 / 0.075 * (0.07 + 0.075 * 0.5)) / (1 + g)
    assert found.std["input_gain:t1+t2", "g"] == pytest.approx(0.01 / abs(per_g), rel=0.15)
