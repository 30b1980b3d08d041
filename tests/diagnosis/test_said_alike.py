"""What a diagnosis says in its sentence, its tables and its JSON is the same."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from facts import holds
from grounded.diagnosis.cause_words import ended
from grounded.diagnosis.error_report import Credit, Remainder, RulerRow
from grounded.diagnosis.pictures import accuracy_figure
from grounded.diagnosis.report import (
    Agreement,
    Diagnosis,
    Estimate,
    Identifiable,
    Made,
    Ranked,
    TrialValue,
    Verdict,
)
from grounded.diagnosis.ruler_words import improvement, rest
from grounded.diagnosis.tables import EFFECTS, effect_table, error_table, of_rivals
from grounded.diagnosis.validation.blame import Blame
from grounded.diagnosis.verdict import UNSURE, verdict
from grounded.effects import Library
from grounded.model import Model, Param
from grounded_trials.report.diagnosis_words import agreement_lines, calibrated_sentence
from grounded_trials.report.three_lines import still_open
from grounded_trials.starting.kinds import EFFORT_UNITS

MODEL = Model(
    states={"x": "m", "v": "m/s"},
    inputs={"u": "V"},
    params={name: Param(2.0, "kg", std=1.0) for name in "abcdefg"},
    derivative=lambda s, a, p: {"x": s.v, "v": a.u / p.a + p.b + p.c + p.d + p.e + p.f + p.g},
)


def _claims(*effects, moved=(), parameters=None):
    return SimpleNamespace(
        known=SimpleNamespace(no_cause=False, sentences=()),
        blamed=(),
        names=tuple(e.name for e in effects),
        best=SimpleNamespace(hypothesis=SimpleNamespace(effects=effects)),
        moved=[Blame(MODEL.param_names.index(name), 9.0) for name in moved],
        parameters=lambda: parameters or {},
        data=SimpleNamespace(model=MODEL),
        one_clock=(),
        off_with_rivals=dict,
        with_rivals=dict,
    )


def _verdict(effect, values, **more):
    row = Ranked(effect.name, values, {}, 50.0, claimed=True)
    return verdict(_claims(effect), (row,), (), (), (), (Credit(effect.name, 1.0),), **more)


def _row(**more):
    units = {"v": "m/s"}
    columns = {"crude": {"v": 1.0}, "with_effects": {"v": 0.5}, "noise_floor": {"v": 0.1}}
    return RulerRow(1.0, False, units, **columns, **more)


@pytest.mark.parametrize("claimed", [3, EFFECTS + 1])
def test_a_claimed_or_tied_effect_always_has_a_row_in_the_table(claimed):
    names = [f"viscous_friction:v{k}" for k in range(EFFECTS + 4)]
    ranking = tuple(
        Ranked(name, {}, {}, 100.0 - k, claimed=k < claimed) for k, name in enumerate(names)
    )
    tie = (names[0], names[-1])
    found = Diagnosis(Verdict("several"), ranking=ranking, indistinguishable=(tie,))
    for rivals in (False, True):
        shown = [cells[0].strip("* ") for cells in effect_table(found, rivals=rivals)[0]]
        assert {*names[:claimed], names[-1]} <= {*shown}
    rivals = [name for name in shown if name not in (*names[:claimed], names[-1])]
    assert len(rivals) == max(EFFECTS - claimed - 1, 0)


def test_evidence_that_a_rival_gains_alone_has_its_own_column():
    ranking = (
        Ranked("delay:u", {}, {}, 120.0, claimed=True),
        Ranked("first_order_lag:u", {}, {}, 118.0),
        Ranked("trend:v", {}, {}, 33.0),
    )
    tie = ("delay:u", "first_order_lag:u")
    found = Diagnosis(Verdict("effect"), ranking=ranking, indistinguishable=(tie,))
    rows, header = effect_table(found)
    lost, alone = (header.index(name) for name in ("evidence [nats]", "alone [nats]"))
    assert [(row[lost], row[alone]) for row in rows] == [
        ("120.0", ""),
        ("118.0", ""),
        ("", "33.0"),
    ]
    rows, header = effect_table(found, rivals=False)
    assert len(rows) == 2 and "alone [nats]" not in header
    told = of_rivals(found)
    assert holds(told, "in place of what is claimed", "beside that, it gains too little")
    assert of_rivals(Diagnosis(Verdict("effect"), ranking=ranking[:1])) == ""
    assert all(len(row) == len(header) for row in rows)


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
        "its values are not determined",
        "c is not determined, k = 0.400 +- 0.10",
        "c = 0 +- 0.010",
    ]


def test_noise_from_trials_that_are_merely_alike_is_a_bound_everywhere():
    """Their scatter also holds the difference of their commands."""
    for source, bound in (("repeats", False), ("alike", True)):
        rows = (_row(floor_from=source),)
        found = Diagnosis(Verdict("none"), prediction_error=rows)
        assert ("noise, at most" in error_table(found)[1]) is bound
        assert ("at most" in improvement(rows)) is bound
        assert ("the most that can be noise" in rest(rows)) is bound


def test_the_noise_of_the_sentence_is_the_noise_of_the_table():
    row = replace(_row(floor_at_most=True), noise_floor={"v": 0.37})
    assert "at most 0.37 m/s" in improvement((row,))
    left = Remainder("v", error=0.5, floor=0.37, horizon_s=1.0, error_unit="m/s")
    assert "at most 0.37 m/s" in replace(left, floor_at_most=True).sentence()


def test_an_error_no_larger_than_a_bound_of_the_noise_does_not_read_as_if_nothing_was_left():
    row = replace(_row(floor_at_most=True), noise_floor={"v": 0.45})
    said = improvement((row,))
    assert "0.45" not in said and said.endswith("is not known: repeat one run to see.")
    known = improvement((replace(row, floor_at_most=False),))
    assert "noise: 0.45 m/s" in known and "not known" not in known
    left = Remainder("v", 0.03, "m/s^2", 12.0, error=0.5, floor=0.45, horizon_s=1.0)
    assert "noise alone" in left.sentence()
    assert "any part" in replace(left, floor_at_most=True).sentence()
    found = Diagnosis(Verdict("effect"), prediction_error=(row,))
    assert "perhaps far less" in accuracy_figure(found).caption


def test_every_tie_is_in_the_verdict_and_in_the_page_s_summary():
    groups = (("delay:u", "first_order_lag:u"), ("trend:v", "offset:v"))
    effect = Library().effect("viscous_friction:v", MODEL)
    row = Ranked(effect.name, {"k": Estimate(1.0, 0.1)}, {}, 50.0, claimed=True)
    credit = (Credit(effect.name, 1.0),)
    said = verdict(_claims(effect), (row,), groups, (), (), credit).sentence
    short = still_open(Diagnosis(Verdict("effect"), indistinguishable=groups))
    assert all(name in text for text in (said, short) for group in groups for name in group)


def test_why_no_cause_is_named_is_a_field_that_survives_json():
    claims = _claims()
    claims.known = SimpleNamespace(no_cause=True, sentences=("one trial", "input u never changed"))
    said = verdict(claims, (), (), (), (), ())
    assert said.limit == "one trial" and said.limit in said.sentence
    found = Diagnosis(said, unknowable=claims.known.sentences)
    assert found.no_cause and Diagnosis.from_json(found.to_json()).no_cause
    other = Diagnosis(replace(said, limit=""), unknowable=claims.known.sentences)
    assert not other.no_cause and "limit" not in other.to_json()["verdict"]


@pytest.mark.parametrize(("std", "sure"), [(0.4, True), (0.6, False), (float("inf"), False)])
def test_the_size_of_a_trend_within_two_standard_deviations_of_zero_is_called_uncertain(std, sure):
    """A log's volts "got 3.93 % stronger every second" by 1.6 standard deviations."""
    effect = Library().effect("input_fade:u", MODEL)
    said = _verdict(effect, {"k": Estimate(-1.0, std, None, "1/s")})
    assert (UNSURE not in said.sentence) is sure
    assert said.causes[0].endswith(UNSURE) is not sure


def test_the_verdict_counts_the_parameters_that_adopt_writes():
    """It named six as off where `adopt` wrote eight."""
    effect = Library().effect("viscous_friction:v", MODEL)
    known = {name: Estimate(2.2, 0.01, None, "kg") for name in "abcd"}
    known |= {name: Estimate(2.02, 0.5, None, "kg") for name in "efg"}
    lost = Identifiable("g", "not identifiable")
    claims = _claims(effect, moved="abcd", parameters=known)
    row = Ranked(effect.name, {"k": Estimate(1.0, 0.1)}, {}, 50.0, claimed=True)
    credit = (Credit("calibration", 0.9), Credit(effect.name, 0.1))
    said = verdict(claims, (row,), (), (), (), credit, identified=(lost,))
    assert holds(said.causes[0], "and 1 more", "e and f are", "at most 1.0 %")
    found = Diagnosis(said, parameters=known, identifiable=(lost,), ranking=(row,))
    written = found.known_parameters
    assert len(written) == 4 + 2
    told = calibrated_sentence(found, dict.fromkeys(known, 2.0))
    assert all(f"{name} 2.00 -> " in told for name in known)
    assert told.count("not adopted") == len(known) - len(written)


def test_trials_that_disagree_are_shown_by_values_that_they_determine():
    """A slew limit of -2.37 +- 2.7 in one trial proves nothing."""
    values = [("t1", -2.4, 2.7), ("t2", 0.8, 0.03), ("t3", 1.4, 0.1), ("t4", 1.5, 0.5)]
    each = tuple(TrialValue(t, "slew_limit:v", "r", v, s) for t, v, s in values)
    one = Agreement("slew_limit:v", "r", agrees=False, estimate=Estimate(0.9, unit="m/s^2"))
    ((title, text),) = agreement_lines(
        Diagnosis(Verdict("effect"), per_trial=each, agreement=(one,))
    )
    assert title == "agreement" and holds(text, "t2", "t3", "0.800 +- 0.030 m/s^2")
    assert "t1" not in text


def test_a_column_of_volts_newtons_or_newton_metres_is_an_effort():
    assert {"V", "N", "N m"} == EFFORT_UNITS


@pytest.mark.parametrize(("value", "way"), [(0.0, "less"), (4.0, "more")])
def test_a_parameter_at_its_lower_bound_asks_for_less(value, way):
    """A friction of "0.00 (-100 %, at its bound, the data ask for more)" needed less."""
    found = Estimate(value, 0.1, unit="kg", stopped="bound")
    assert ended(found, 2.0) == (f"at its bound, the data ask for {way}",)
    assert not ended(replace(found, stopped=""), 2.0)
    effect = Library().effect("viscous_friction:v", MODEL)
    row = Ranked(effect.name, {"k": Estimate(1.0, 0.1)}, {}, 50.0, claimed=True)
    credit = (Credit(effect.name, 0.6), Credit("calibration", 0.4))
    claims = _claims(effect, moved="a", parameters={"a": found})
    assert f"ask for {way}" in verdict(claims, (row,), (), (), (), credit).sentence
    made = Made(nominal={"a": 2.0})
    whole = Diagnosis(Verdict("effect", effects=(effect.name,)), parameters={"a": found}, made=made)
    assert f"ask for {way}" in calibrated_sentence(whole, {})
