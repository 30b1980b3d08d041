"""How sure values are: by the information, by priors, beside what is held or hides them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from grounded import Model, Param, Trial, diagnose
from grounded.diagnosis.diagnose import DiagnosisOptions
from grounded.diagnosis.hypotheses.search import TO_THE_TOP, HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.intervals import standard_deviations
from grounded.diagnosis.validation.claims import moved_parameters
from grounded.diagnosis.validation.identifiable import identified
from grounded.effects import Library, wrap
from grounded_trials.logs.resample import to_grid
from grounded_trials.logs.signals import Series, SignalSpec
from stepped import levels, library, logged, stepped

DT = 0.05


def cart(drag, std=0.05):
    """A cart whose force and mass show only as a ratio, unless it has a drag that is known."""
    return Model(
        states={"v": "m/s"},
        inputs={"u": "N"},
        params={"m": Param(2.0, "kg", std=std)},
        derivative=lambda s, a, p: {"v": (a.u - drag * s.v) / p.m},
    )


def driven(real, size=4.0):
    """Four runs under random levels."""
    rng = np.random.default_rng(3)
    sent = [levels(rng, 10, 8, size, real.m) for _ in range(4)]
    return [logged(real, stepped(real, u, DT), u, DT, 1e-3, rng) for u in sent]


def test_a_gain_beside_an_uncertain_mass_is_as_uncertain_as_the_mass():
    weaker = wrap(Library().effect("input_gain:u", cart(0.0)), {"g": -0.3}, DT)
    alone = DiagnosisOptions(library=library("input_gain"))
    found = diagnose(cart(0.0), driven(weaker), alone)
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


def test_the_scale_of_a_planar_arm_rests_on_the_surest_inertia():
    model, real, h = planar(), planar(), Hypothesis(shift=np.zeros(3), spread=1.0)
    for name in reversed(PLANAR):
        real = wrap(Library().effect(name, real), PLANAR[name], DT)
    data = prepare(model, driven(real, 2.0))
    for name, values in PLANAR.items():
        h = h.plus(Library().effect(name, model, data.scales), values)
    search = HypothesisSearch(data, ())
    (fit,) = search.refined([search.fresh(h)], TO_THE_TOP)
    found = identified(search.predictor, fit)
    (one,) = found.combinations
    assert {*one.values} == {*PLANAR, "load"} and one.rests_on == {"I1": 0.01}
    g = fit.hypothesis.values[0]["g"]
    # I1 + 0.2 + 0.09 load is in proportion to the torques, and so is 0.07 + 0.075 load
    per_g = (0.245 + 0.09 * 0.5 - 0.09 / 0.075 * (0.07 + 0.075 * 0.5)) / (1 + g)
    assert found.std["input_gain:t1+t2", "g"] == pytest.approx(0.01 / abs(per_g), rel=0.15)


def test_a_gain_follows_the_mass_that_is_held():
    """A cart only tells k / m, and b; its crude model is sure of m to 20 %."""
    model = Model(
        states={"v": "m/s"},
        inputs={"u": "V"},
        params={
            "m": Param(1.0, "kg", std=0.2),
            "k": Param(1.0, "N/V", std=0.5),
            "b": Param(0.5, "1/s", std=0.3),
        },
        derivative=lambda s, a, p: {"v": p.k / p.m * a.u - p.b * s.v},
    )
    rng, real = np.random.default_rng(0), {"m": 1.25, "k": 1.5, "b": 0.6}
    sent = [np.sin(rng.uniform(1, 4) * np.arange(150) * DT) for _ in range(3)]
    true = [stepped(model.with_values(real), u, DT) for u in sent]
    trials = [logged(model, x, u, DT, 3e-3, rng) for x, u in zip(true, sent, strict=True)]
    found = diagnose(model, trials, DiagnosisOptions(library=Library(())))  # calibration alone
    by = {one.parameter: one for one in found.identifiable}
    assert by["k"].given == pytest.approx({"m": 1.0}, abs=0.1) and not by["b"].given
    k = found.parameters["k"]
    assert k.value == pytest.approx(1.5 / 1.25, rel=0.02)
    assert abs(1.5 - k.value) > 5 * k.std  # with m as written
    assert abs(1.5 - k.value) < 2 * by["k"].prior * by["k"].left  # with all free
    (one,) = [f for f in found.findings if f.code == "model.given"]
    assert one.about == ("k",) and one.facts["rests"] == ("m",)


def test_of_two_parameters_that_hide_each_other_one_stays():
    boat = Model(
        states={"v": "m/s"},
        inputs={"u": "N"},
        params={"a": Param(0.5, std=0.3), "b": Param(0.5, std=0.3), "gain": Param(1.0, std=0.3)},
        derivative=lambda s, a, p: {"v": p.gain * a.u - p.a * s.v - p.b * s.v**3},
        integrator="euler",
    )
    rng, real = np.random.default_rng(1), boat.with_values({"a": 0.8, "b": 0.7, "gain": 1.3})
    sent = [levels(rng, 10, 8, 3.0) for _ in range(3)]
    trials = [logged(boat, stepped(real, u, 0.05), u, 0.05, 1e-3, rng) for u in sent]
    search = HypothesisSearch(prepare(boat, trials), ())
    fit = search.nulls()
    without = SimpleNamespace(held_out=False)
    assert {*moved_parameters(search, fit, without)} == {0, 1, 2}

    def gain(less, whole):
        a, b, needed = np.abs(less.hypothesis.shift) > 1e-9
        return SimpleNamespace(mean=0.0 if needed and (a or b) else 1.0)

    ruler = SimpleNamespace(held_out=True, since_outset=lambda fit: 1.0, gain=gain)
    left = {*moved_parameters(search, fit, ruler)}
    assert 2 in left and len(left) == 2


def test_a_delay_is_no_surer_than_states_between_two_samples():
    """Of a rover's log at 50 Hz on a grid of 20 Hz: 0.0461 +- 0.0001 s, of 0.050 s."""
    motor = Model(
        states={"w": "rad/s"},
        inputs={"u": "rad/s"},
        derivative=lambda s, a, p: {"w": (a.u - s.w) / 0.1},
    )
    rng, h, series = np.random.default_rng(0), 1e-3, {}
    sent = levels(rng, 40, 750)
    w = stepped(motor, np.concatenate([np.zeros((50, 1)), sent])[:30_000], h)[:, 0]
    w = w[:30_000:20] + 1e-3 * rng.standard_normal(1500)
    for name, y, every in (("w", w, 20), ("u", sent[::50, 0], 50)):
        stamps, spec = np.int64(1e9 * h * every) * np.arange(len(y)), SignalSpec(f"/{name}.data")
        series[name] = Series(spec, stamps, y, stamps, len(y), "a/B")
    log = to_grid(series, 0.05, ["w"], ["u"])
    assert log.interpolated_s == pytest.approx(0.0025, abs=1e-4)
    trial = Trial(log.states, log.inputs, 0.05, ("w",), ("u",))
    found = diagnose(motor, [trial], DiagnosisOptions(interpolated_s=log.interpolated_s))
    (row,) = (one for one in found.ranking if one.claimed)
    d, least = row.params["d"], log.interpolated_s
    assert row.effect == "sensor_delay:w" and abs(d.value - 0.05) < 2 * d.std
    assert least <= d.std < least + 1e-3


def test_values_are_no_surer_than_the_constant_that_was_tuned_beside_them():
    model = Model(
        states={"q": "rad", "w": "rad/s"},
        inputs={"tau": "N m"},
        derivative=lambda s, a, p: {"q": s.w, "w": a.tau / 0.02},
    )

    def rates(x, u):
        return np.array([x[1], (u[0] - 0.08 * np.clip(x[1] / 0.3, -1, 1)) / 0.02])

    rng, trials, dt = np.random.default_rng(3), [], 0.01
    u = sum(a * np.sin(f * dt * np.arange(300)) for a, f in ((0.2, 9.0), (0.15, 23.0)))
    for _ in range(3):
        x = stepped(rates, u, dt, np.zeros(2), fine=4, disturbed=np.array([0, 1e-3]), rng=rng)
        trials.append(logged(model, x, u, dt, [1e-4, 3e-3], rng))
    data = prepare(model, trials)
    effect = Library().effect("joint_friction:tau<-w", model, data.scales)
    untuned = tuple(replace(q, tuned=False) for q in effect.quantities)
    search, std = HypothesisSearch(data, (effect,)), []
    h = Hypothesis().plus(effect, {"c": 0.08, "b": 0.0, "width": 0.3})
    for one in (replace(h, effects=(replace(effect, quantities=untuned),)), h):
        (fit,) = search.refined([search.fresh(one)], 20)
        std.append(standard_deviations(search.predictor, fit, data.trial_of)[0])
    assert len(std[0]) == len(std[1]) == len(h.theta)
    assert std[1][0] > 1.2 * std[0][0]
