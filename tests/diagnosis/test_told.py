"""What a diagnosis tells: its document, its rows of errors, its findings by code."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from grounded.diagnosis.causes import meaning
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.error_report import (
    Credit,
    Remainder,
    RulerRow,
    excess,
    furthest,
    lost_most,
    telling,
)
from grounded.diagnosis.parts import (
    Agreement,
    Changed,
    Diagnosis,
    Estimate,
    Made,
    Ranked,
    TrialGroup,
    TrialValue,
    Verdict,
)
from grounded.diagnosis.telling import accuracy_figure, effect_table, told
from grounded.diagnosis.validation.measured import Measured
from grounded.diagnosis.writer import remarks
from grounded.effects import Library
from grounded.errors import GroundedError
from grounded.model import Model, Param
from grounded.result import Document
from reported import DIAGNOSIS
from small_tasks import pushed_cart, pushed_cart_task


def again(found: Document) -> Any:
    """What is read from the text that is kept."""
    return type(found).from_json(json.loads(json.dumps(found.to_json(), allow_nan=False)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "trials", "changes"),
    [("effect", 3, {"friction": 0.4}), ("unknown", 1, {"friction": 0.4})],
)
def test_a_real_diagnosis_is_read_back_as_it_was(kind, trials, changes):
    model, runs = pushed_cart(trials=trials, steps=120, **changes)
    few = ("coulomb_friction", "viscous_friction", "input_gain", "delay", "offset")
    library = Library(tuple(Library().family(name) for name in few))
    found = diagnose(pushed_cart_task(model), runs, DiagnosisOptions(library=library))
    assert found.kind == kind
    read = again(found)
    assert read == found and read.to_json() == found.to_json()
    assert read.values("coulomb_friction:v") == found.values("coulomb_friction:v")
    assert len(repr(found)) < 200 and kind in repr(found)
    assert found.findings and found.to_json()["findings"][0]["code"] and found.next_trial


def test_an_older_document_is_read_with_what_it_has():
    found = Diagnosis.from_json(DIAGNOSIS)
    assert found.made == Made() and found.probe == "" and not found.ranking[0].claimed
    assert found.values("viscous_friction:v") == {"k": 0.3}
    assert again(found) == found
    oldest = Diagnosis.from_json({"verdict": {"kind": "none"}})
    assert math.isnan(oldest.gap.before) and oldest.ranking == ()
    assert again(oldest) == oldest
    unknown = {"code": "gap.of_old", "weight": "note", "about": [], "facts": {}, "nats": None}
    other = unknown | {"code": "gap.tie"}  # whose facts had other names
    both = [one | {"then": None} for one in (unknown, other)]
    later = Diagnosis.from_json({"verdict": {"kind": "none"}, "findings": both})
    assert later.findings == () and later.sentence


@pytest.mark.parametrize(
    "document",
    [
        3,
        [],
        {},
        {"verdict": 3},
        {"verdict": {}},
        {"verdict": {"kind": "none"}, "ranking": [None]},
        {"verdict": {"kind": "none"}, "gap": {"before": "much"}},
        {"verdict": {"kind": "none"}, "trials": 1e400},
        {"verdict": {"kind": "none"}, "diagnosed": {"adopted": [{"c": 1.0}]}},
        {"verdict": {"kind": "none"}, "where": {"channels": [None]}},
    ],
)
def test_what_is_no_diagnosis_is_refused(document):
    with pytest.raises(GroundedError, match="Diagnosis"):
        Diagnosis.from_json(document)


def test_a_gap_in_one_second_of_one_log_is_told_with_its_time():
    total, count = np.full((1, 9, 1), 1e-6), np.full((1, 9, 1), 10.0)
    total[0, 6] = 1e-3  # the third second of the second run, which begins at 4 s of t2
    fake = SimpleNamespace(
        ruler=SimpleNamespace(
            errors=lambda fit: SimpleNamespace(total=total, count=count),
            run_of=np.repeat([0, 1], [4, 5]),
            piece0=np.array([0, 4, 9]),
            step0=np.array([0, 40]),
            steps=(1, 10),
        ),
        data=SimpleNamespace(
            dt=0.1, trial_of=np.array([0, 1]), step_at=np.array([[0], [80]]), lengths=[40, 85]
        ),
        trials=[SimpleNamespace(id="t1"), SimpleNamespace(id="t2")],
        best=None,
    )
    found = Measured.part(fake, 0, 0, 3e-4)
    assert (found.trial, found.start, found.end) == ("t2", 6.0, 7.0) and found.share > 0.98
    assert Measured.part(fake, 0, 0, 0.1) is None  # all of it may be noise
    count[0, 6] = 30.0  # of 110: not a short part
    assert Measured.part(fake, 0, 0, 3e-4) is None


def test_the_error_over_whole_trials_is_no_error_at_a_horizon():
    def row(seconds, error, whole=False):
        return RulerRow(seconds, whole, {"x": "m"}, crude={"x": error}, with_effects={"x": error})

    rows = (row(0.5, 1.0), row(1.0, 2.0), row(2.0, 0.3, whole=True))
    (panel,) = accuracy_figure(Diagnosis(Verdict("none"), prediction_error=rows)).panels
    line, apart = panel.curves
    assert ([*line["x"]], [*line["y"]]) == ([0.5, 1.0], [1.0, 2.0])
    assert (apart["mode"], [*apart["y"]], line["name"]) == ("markers", [0.3], apart["name"])
    assert "whole trial" in apart["hovertemplate"]
    assert panel.layout["xaxis"]["ticktext"] == ["0.5", "1", "whole<br>trial"]
    assert panel.layout["xaxis"]["ticklabeloverflow"] == "allow"  # it was hidden at the edge
    (alone,) = accuracy_figure(Diagnosis(Verdict("none"), prediction_error=rows[2:])).panels
    assert alone.layout["xaxis"]["ticktext"] == ["whole<br>trial"] and len(alone.curves) == 1


def row(crude, after, floor=None, **more):
    return RulerRow(
        more.pop("horizon_s", 1.0),
        unit_by_channel={"x": "m", "v": "m/s"},
        crude=crude,
        with_effects=after,
        noise_floor=floor or {},
        **more,
    )


def whole(crude, after, **more):
    return row(crude, after, whole_trial=True, horizon_s=60.0, **more)


SHORT = row({"x": 0.2, "v": 0.5}, {"x": 0.1, "v": 0.6})
LONG = whole({"x": 2.12, "v": 0.5}, {"x": 3.79, "v": 0.3})


def test_what_noise_alone_drowns_or_what_diverges_is_not_told():
    far = row({"x": 2.0, "v": 5.0}, {"x": 1.9, "v": 9.0}, drowned=True)
    near = replace(SHORT, with_effects={"x": 0.1, "v": 0.5}, horizon_s=0.5)
    assert furthest((near, far)) is near and furthest((far,)) is far and furthest(()) is None
    assert lost_most((near, far)) is None and telling((near, far, LONG)) is near
    away = dict.fromkeys(("crude", "with_effects", "noise_floor"), ("x",))
    wild = whole({"x": 7e5, "v": 0.5}, {"x": 4e5, "v": 0.4}, runs_away=away)
    assert not wild.tells("x", "crude") and wild.tells("v", "crude")
    assert excess((near, wild)) is None and telling((near, wild)) is near


def test_a_slow_plant_is_told_by_whole_trials():
    slow, quick = row({"x": 0.02}, {"x": 0.017}), row({"x": 0.2}, {"x": 0.08})
    hour = whole({"x": 5.0}, {"x": 0.3})
    assert telling((slow, hour)) is hour and telling((quick, hour)) is quick
    assert telling((hour,)) is None and telling(()) is None


ALIKE, UNLIKE = (Agreement("delay:u", "d", agrees=agrees) for agrees in (True, False))
LITTLE, MUCH = (row({"x": 2.0, "v": 1.0}, {"x": x, "v": 1.0}) for x in (1.7, 0.5))
PAIR = ("sensor_delay:psi", "coupling:p<-phi")
LEFT, WIDE = ((Remainder("x", error=e, floor=1.0),) for e in (1.5, 3.5))


@pytest.mark.parametrize(
    ("given", "contested"),
    [
        (((SHORT, LONG), (ALIKE,), ("delay:u",)), True),
        (((SHORT, LONG), (ALIKE,), ()), False),
        (((SHORT,), (ALIKE,), ("delay:u",)), False),
        (((SHORT,), (UNLIKE,), ("delay:u",)), True),
        (((LITTLE,), (), PAIR[:1], [PAIR], LEFT), True),  # a tie that gains little beside a gap
        (((LITTLE,), (), PAIR[:1], [PAIR]), False),
        (((MUCH,), (), PAIR[:1], [PAIR], LEFT), False),
        (((LITTLE,), (), PAIR[:1], [], LEFT), False),
        (((LITTLE,), (), ("periodic:p",), [], WIDE), True),
        (((MUCH,), (), ("periodic:p",), [], WIDE), False),
        (((LITTLE,), (), (PAIR[0], "delay:u"), [PAIR], LEFT), False),
    ],
)
def test_a_claim_is_contested(given, contested):
    names = ("prediction_error", "agreement", "effects", "indistinguishable", "leftover")
    parts = dict(zip(names, given, strict=False))
    verdict = Verdict("effect", parts.pop("effects"))
    assert bool(Diagnosis(verdict, **parts).doubt) is contested


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


FRICTION = "viscous_friction:v"
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


def codes(found):
    return [one.code.removeprefix("gap.") for one in remarks(found, MODEL)]


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
