"""A parameter that is known only together with one that is held says so."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from grounded.diagnosis.verdict import _causes
from grounded_trials.report.diagnosis_words import error_lines, held_sentence

from grounded import Model, Param, Trial
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.error_report import Credit, Identifiable
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.parts import Estimate
from grounded.diagnosis.validation import claims as claims_of
from grounded.diagnosis.validation.blame import Blame
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
    assert "given m as in the model" in found.sentence


def test_table_and_document_say_it(found):
    again = type(found).from_json(found.to_json())
    assert [one.given for one in again.identifiable] == [one.given for one in found.identifiable]
    assert "held" in dict(
        error_lines(again, {})
    ) and "k changes by +1 % with 1 % more m" in held_sentence(again)
    free = replace(found, identifiable=tuple(replace(i, given={}) for i in found.identifiable))
    assert "held" not in dict(error_lines(free, {}))


def test_a_value_that_its_std_stopped_is_told_with_what_to_widen():
    """It was told with a tight +-, and without a word that three std were used up."""
    model, trials = motor(2)
    known = {"m": Param(1.0, "kg"), "k": Param(1.0, "N/V", std=0.05)}
    sure = replace(model, params={**model.params, **known})
    said = diagnose(sure, trials, DiagnosisOptions(library=Library(())))
    assert said.parameters["k"].value == pytest.approx(1.15)
    assert {n for n, e in said.parameters.items() if e.stopped == "prior"} == {"k"}
    assert "k should be 1.15" in said.sentence and "at the limit of its std" in said.sentence
    assert "widen its std" in said.sentence
    again = type(said).from_json(said.to_json())
    assert again.parameters["k"].stopped == "prior"
    beside = replace(again, verdict=replace(again.verdict, effects=("delay:u",)))
    text = dict(error_lines(beside, {"k": 1.0, "b": 0.5}))["parameters"]
    assert "N/V (at the limit of its std" in text and text.count("std") == 1


def test_a_value_that_adopt_leaves_alone_is_told_as_not_determined():
    """The verdict gave a new value, and `adopt` kept the old one, as not determined."""
    model, _ = motor(1)
    claims = SimpleNamespace(
        best=SimpleNamespace(hypothesis=SimpleNamespace(effects=())),
        data=SimpleNamespace(model=model),
        moved=(Blame(model.param_names.index("k"), 9.0),),
        parameters=lambda: {"k": Estimate(1.3, 0.4, None, "N/V")},
        with_rivals=dict,
    )
    parts = [Identifiable("k", verdict, 1.0, 1.0, {}) for verdict in ("weak", "not identifiable")]
    told = [_causes(claims, (), [Credit("calibration")], [part], {})[0] for part in parts]
    assert told[1].startswith(told[0]) and told[1].endswith("do not determine k")
    assert "determine" not in told[0]


def test_of_many_adjusted_parameters_those_that_move_most_are_named():
    """`10 others are adjusted with it by at most 59 %` named none."""
    params = {f"p{k}": Param(1.0 + k, "kg", 0.1, 99.0) for k in range(6)}
    model = Model(states={"v": "m/s"}, inputs={"u": "N"}, params=params, derivative=dict)
    known = {f"p{k}": Estimate(1.0 + k + (-1) ** k * 0.1 * k, 0.01, None, "kg") for k in range(6)}
    claims = SimpleNamespace(
        best=SimpleNamespace(hypothesis=SimpleNamespace(effects=())),
        data=SimpleNamespace(model=model),
        moved=(Blame(5, 9.0),),
        parameters=lambda: known,
        off_with_rivals=dict,
        with_rivals=dict,
    )
    (told,) = _causes(claims, (), [Credit("calibration")], (), {})
    most = "5 others are adjusted with it, most of all p4 (+8.0 %), p3 (-7.5 %) and p2 (+6.7 %)"
    assert f"; {most}, but need not be wrong" in told
    params["delay_u_d"] = Param(0.03, "s", 0.001, 0.1)
    known["delay_u_d"] = Estimate(0.045, 0.001, None, "s")
    claims.data = SimpleNamespace(model=replace(model, params=params))
    (told,) = _causes(claims, (), [Credit("calibration")], (), {}, adopted=("delay:u",))
    assert "most of all d of delay:u (+50 %), p4" in told
    known.pop("delay_u_d"), known.pop("p0"), known.pop("p1"), known.pop("p2")
    (told,) = _causes(claims, (), [Credit("calibration")], (), {})
    assert told.endswith("; p3 and p4 are adjusted with it by at most 8.0 %, but need not be wrong")
    known["p4"] = replace(known["p4"], interval=(5.3, 5.5))  # which excludes the model's 5
    (excluded,) = _causes(claims, (), [Credit("calibration")], (), {})
    assert excluded.endswith("are adjusted with it by at most 8.0 %, which predictions hardly need")
    known["p4"] = replace(known["p4"], interval=(4.9, 5.9))
    claims.off_with_rivals = lambda: {"p4": "drag:v"}
    (tied,) = _causes(claims, (), [Credit("calibration")], (), {})
    assert tied == f"{told}; if drag:v is the cause instead, p4 is off"


def test_a_parameter_that_is_off_only_with_an_effect_that_ties_is_found(monkeypatch):
    """Of a motor `K need not be wrong`: with a plain friction, which tied, it was off by 15 %."""
    off = {"plain": (Blame(0, 9.0), Blame(1, 9.0)), "drag": (Blame(1, 9.0),)}
    monkeypatch.setattr(claims_of, "moved_parameters", lambda search, fit, ruler: off[fit])
    claims = SimpleNamespace(
        names=("loaded",),
        moved=(Blame(1, 9.0),),
        best=SimpleNamespace(hypothesis=SimpleNamespace(spread=0.1)),
        rivals=lambda name: [("drag:v", "drag"), ("joint_friction:u<-v", "plain")],
        data=SimpleNamespace(model=motor(1)[0]),
        search=None,
        ruler=None,
    )
    assert claims_of.Claims.off_with_rivals(claims) == {"m": "joint_friction:u<-v"}
    claims.best.hypothesis.spread = 0.0  # no parameter is calibrated
    assert claims_of.Claims.off_with_rivals(claims) == {}


def test_a_value_that_goes_with_a_tied_effect_says_what_it_is_with_the_other():
    """A rover's lag of 0.18 s "should be 0.21048 +- 0.00025 s", beside a damping that tied."""
    model, _ = motor(1)

    def rival(*shift):
        return SimpleNamespace(hypothesis=SimpleNamespace(shift=np.array(shift)))

    claims = SimpleNamespace(
        names=("viscous_friction:v",),
        moved=(Blame(1, 9.0), Blame(2, 9.0)),
        best=SimpleNamespace(hypothesis=SimpleNamespace(spread=0.1)),
        rivals=lambda name: [("input_gain:u", rival(0.0, 0.3, 0.2))],
        data=SimpleNamespace(model=model),
        parameters=lambda: {n: Estimate(v, 0.01, None, "") for n, v in (("k", 1.5), ("b", 0.7))},
    )
    both = "viscous_friction:v", "input_gain:u"
    found = claims_of.Claims.with_rivals(claims)
    assert found == {"k": (*both, pytest.approx(1.3))}  # b is 0.7 with either
    claims.rivals = lambda name: [("input_gain:u", SimpleNamespace(hypothesis=Hypothesis()))]
    assert claims_of.Claims.with_rivals(claims)["b"] == (*both, 0.5)  # held, as the model has it
    claims.best.hypothesis.spread = 0.0
    assert claims_of.Claims.with_rivals(claims) == {}


def test_a_line_names_no_twenty_parameters():
    """An aircraft's page had a paragraph of them, all known together with one inertia."""
    names = [f"C{k}" for k in range(20)]
    parts = [Identifiable(n, "weak", 1.0, 0.01, {"J": 0.9 + k / 1e3}) for k, n in enumerate(names)]
    known = {n: Estimate(1.0, 0.1, "1/rad") for n in names}
    said = held_sentence(SimpleNamespace(identifiable=parts, parameters=known))
    assert "20 others" in said and "+0.9 to +0.92 % with 1 % more J" in said and "C3" not in said
    assert "C0" in held_sentence(SimpleNamespace(identifiable=parts[:2], parameters=known))


def test_a_sum_in_a_sentence_has_its_largest_terms_and_on_the_page_all():
    given = {"a": 0.1, "b": -2.0, "c": 0.3, "d": 1.0}
    parts = [Identifiable("k", "weak", 1.0, 0.01, given)]
    known = SimpleNamespace(identifiable=parts, parameters={"k": Estimate(1.0, 0.1, "N")})
    short, whole = held_sentence(known), held_sentence(known, whole=True)
    terms = ["-2 % with 1 % more b", "+1 % with 1 % more d", "more c", "more a"]
    assert [term in short for term in terms] == [True, True, False, False] and "smaller" in short
    assert all(term in whole for term in terms) and "smaller" not in whole
    known.identifiable = [Identifiable("k", "weak", 1.0, 0.01, dict([*given.items()][:3]))]
    assert "smaller" not in held_sentence(known)


@pytest.mark.parametrize(
    ("off", "named"),
    [
        ({"m": 4.0, "k": 0.5, "b": 1.5}, {"m", "b"}),  # b by evidence, k by no more than trials do
        ({"m": 1.9, "k": 0.5, "b": 1.5}, {"m", "k", "b"}),  # together, if none is alone
    ],
)
def test_what_trials_disagree_about_by_as_much_is_not_off(off, named):
    """Twelve of an aircraft's 32 parameters "off" were so by less than their +-."""
    model, _ = motor(1)
    sizes = [off[name] for name in model.param_names]
    estimates = {
        name: Estimate(param.value + 0.1 * size, 0.1, None, param.unit)
        for (name, param), size in zip(model.params.items(), sizes, strict=True)
    }
    claims = SimpleNamespace(data=SimpleNamespace(model=model), parameters=lambda: estimates)
    blamed = [Blame(i, 9.0) for i in range(3)]
    kept = claims_of.Claims._known(claims, blamed)
    assert {model.param_names[one.index] for one in kept} == named
    slight = [Blame(i, 9.0 if size > 2 else 2.0) for i, size in enumerate(sizes)]
    kept = claims_of.Claims._known(claims, slight)  # too few nats: 2 standard deviations then
    assert {model.param_names[one.index] for one in kept} == (
        named - {"b"} if 4 in sizes else named
    )
    assert claims_of.Claims._known(claims, []) == ()
