"""What a diagnosis says in its sentence, its tables and its JSON is the same."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
from grounded.diagnosis.cause_words import meaning
from grounded.diagnosis.verdict import verdict
from grounded_trials.report.diagnosis_words import calibrated_sentence

from grounded.diagnosis.error_report import Credit
from grounded.diagnosis.parts import Estimate, Identifiable, Ranked, Verdict
from grounded.diagnosis.report import Diagnosis
from grounded.diagnosis.tables import EFFECTS, effect_table
from grounded.diagnosis.validation.blame import Blame
from grounded.effects import Library
from grounded.model import Model, Param

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


def test_every_effect_has_a_meaning_in_words_for_any_value():
    for effect in Library().candidates(MODEL):
        known = {q.name: Estimate(0.1, 0.0, (0.1, 0.1), q.unit) for q in effect.quantities}
        assert "{" not in meaning(effect, known)


def test_why_no_cause_is_named_is_a_field_that_survives_json():
    claims = _claims()
    claims.known = SimpleNamespace(no_cause=True, sentences=("one trial", "input u never changed"))
    said = verdict(claims, (), (), (), (), ())
    assert said.limit == "one trial" and said.limit in said.sentence
    found = Diagnosis(said, unknowable=claims.known.sentences)
    assert found.no_cause and Diagnosis.from_json(found.to_json()).no_cause
    other = Diagnosis(replace(said, limit=""), unknowable=claims.known.sentences)
    assert not other.no_cause and "limit" not in other.to_json()["verdict"]


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
    found = Diagnosis(said, parameters=known, identifiable=(lost,), ranking=(row,))
    written = found.known_parameters
    assert len(written) == 4 + 2
    told = calibrated_sentence(found, dict.fromkeys(known, 2.0))
    assert all(f"{name} 2.00 -> " in told for name in known)
    assert told.count("not adopted") == len(known) - len(written)
