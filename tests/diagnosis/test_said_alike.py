"""What is told of a diagnosis: three lines, a table of causes, findings by code."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.diagnosis.causes import meaning
from grounded.diagnosis.error_report import Credit, Remainder, RulerRow
from grounded.diagnosis.parts import (
    Agreement,
    Changed,
    Diagnosis,
    Estimate,
    Ranked,
    TrialGroup,
    TrialValue,
    Verdict,
)
from grounded.diagnosis.telling import effect_table, told
from grounded.diagnosis.writer import remarks
from grounded.effects import Library
from grounded.model import Model, Param

MODEL = Model(
    states={"x": "m", "v": "m/s"},
    inputs={"u": "V"},
    params={name: Param(2.0, "kg", std=1.0) for name in "abcdefg"},
    derivative=lambda s, a, p: {"x": s.v, "v": a.u / p.a + p.b + p.c + p.d + p.e + p.f + p.g},
)


def test_a_value_that_anything_fits_has_no_digits():
    """A tied friction with c = 285 +- 2e7 is neither 285 nor known to +- 2e7."""
    wide, near, small = Estimate(285.0, 2e7), Estimate(0.4, 0.1), Estimate(1e-6, 0.01)
    ranking = (
        Ranked("a:v", {"c": wide}, {}, 120.0, claimed=True),
        Ranked("b:v", {"c": wide, "k": near}, {}, 118.0),
        Ranked("c:v", {"c": small}, {}, 117.0),
    )
    values = [row[-1] for row in effect_table(Diagnosis(Verdict("effect"), ranking=ranking))[0]]
    assert values == [
        "c = unknown",
        "c = unknown, k = 0.400 +- 0.10",
        "c = 0 +- 0.010",
    ]


def test_every_effect_has_a_meaning_in_words_for_any_value():
    for effect in Library().candidates(MODEL):
        known = {q.name: Estimate(0.1, 0.0, (0.1, 0.1), q.unit) for q in effect.quantities}
        assert "{" not in meaning(effect, known)


FRICTION, DRAG = "viscous_friction:v", "quadratic_drag:v"
ERRORS = RulerRow(
    1.0,
    unit_by_channel={"x": "m", "v": "m/s"},
    crude={"x": 0.2, "v": 0.5},
    with_effects={"x": 0.02, "v": 0.1},
    noise_floor={"x": 0.01, "v": 0.1},
)


def diagnosed(**more) -> Diagnosis:
    row = Ranked(FRICTION, {"k": Estimate(0.4, 0.02, None, "1/s")}, {}, 90.0, claimed=True)
    parts = {
        "verdict": Verdict("effect", (FRICTION,), ("v is damped by 0.4 1/s",)),
        "ranking": (row,),
        "credit": (Credit(FRICTION, 0.9),),
        "prediction_error": (ERRORS,),
        "trials": 3,
        "groups": (TrialGroup("g1"), TrialGroup("g2")),
    }
    return Diagnosis(**parts | more)


def codes(found, adopted=()):
    return [one.code.removeprefix("gap.") for one in remarks(found, MODEL, adopted)]


def test_three_lines_say_what_how_good_and_what_is_open():
    left = Remainder("v", error=0.3, floor=0.1, horizon_s=1.0, error_unit="m/s")
    said = told(diagnosed(leftover=(left,)))
    assert [one.code for one in said.lines] == ["gap.causes", "gap.errors", "gap.left"]
    errors = said.lines[1].facts
    assert (errors["state"], errors["now"].value, errors["before"].value) == ("x", 0.02, 0.2)
    assert said.rows == ((FRICTION, "k = 0.400 +- 0.020 1/s", "90 %"),)


@pytest.mark.parametrize(
    ("verdict", "rows", "code"),
    [
        (Verdict("none"), (ERRORS,), "gap.none"),
        (Verdict("unknown"), (ERRORS,), "gap.unknown"),
        (Verdict("unknown", limit="model.few"), (ERRORS,), "gap.too_few"),
    ],
)
def test_without_a_cause_the_first_line_says_so(verdict, rows, code):
    found = Diagnosis(verdict, prediction_error=rows)
    said = told(found)
    assert said.lines[0].code == code and found.no_cause is bool(verdict.limit)
    assert not found.no_cause or not said.rows
    assert Diagnosis.from_json(found.to_json()) == found


def test_trials_that_disagree_are_told_with_the_two_that_differ_most():
    each = [(0.3, 0.01), (0.6, 0.01), (9.0, 50.0)]
    values = tuple(TrialValue(f"t{i}", FRICTION, "k", *one) for i, one in enumerate(each))
    test = Agreement(FRICTION, "k", agrees=False, estimate=Estimate(0.4, 0.1, None, "1/s"))
    found = diagnosed(per_trial=values, agreement=(test,))
    (one,) = [f for f in remarks(found, MODEL) if f.code == "gap.disagree"]
    assert (one.facts["trial"], one.facts["trial2"]) == ("t0", "t1")


def test_what_changed_between_two_groups_is_told_by_value():
    values = Estimate(0.0496, 0.0002, unit="m"), Estimate(0.0459, 0.0002, unit="m")
    name = "first_order_lag_u_tau"
    one = Changed(f"parameter:{name}", name, *values, 190.0)
    found = diagnosed(changed=(one,))
    (said,) = [f for f in remarks(found, MODEL, ["first_order_lag:u"]) if f.code == "gap.changed"]
    assert said.facts["value"] == "tau of first_order_lag:u" and said.nats == 190.0
    (said,) = [f for f in remarks(replace(found, changed=()), MODEL) if f.code == "gap.changed"]
    assert "value" not in said.facts


def test_errors_that_grow_and_values_at_bounds_are_told():
    worse = replace(ERRORS, with_effects={"x": 0.4, "v": 0.1})
    stopped = {"a": Estimate(3.0, 0.1, None, "kg", "bound")}
    found = diagnosed(prediction_error=(worse,), parameters=stopped)
    said = {one.code: one for one in remarks(found, MODEL)}
    assert said["gap.worse"].facts["state"] == "x" and said["model.at_bound"].about == ("a",)
    gain = Ranked("input_gain:u", {"g": Estimate(9.0, 0.1)}, {}, 9.0, claimed=True)
    assert "sign" not in codes(diagnosed(ranking=(gain,)))
    turned = replace(gain, params={"g": Estimate(-2.0, 0.1)})
    assert "sign" in codes(diagnosed(ranking=(turned,)))
    once = diagnosed(groups=(TrialGroup("g1"),), leftover=(Remainder("v", 0.1),))
    assert "one_motion" in codes(once)
    assert np.isnan(said["gap.worse"].nats)
