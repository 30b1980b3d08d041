"""A diagnosis and its document are one: written and read back, nothing is lost."""

import json
import math
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.error_report import Gap, Region, Remainder, Where
from grounded.diagnosis.parts import Estimate, Made, Ranked, Verdict
from grounded.diagnosis.report import Diagnosis
from grounded.effects import Library
from grounded.errors import GroundedError
from grounded.result import Document
from reported import DIAGNOSIS
from small_tasks import pushed_cart, pushed_cart_task

NUMBERS = st.floats(allow_nan=True, allow_infinity=True)
NAMES = st.text(max_size=8)


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


def estimates() -> st.SearchStrategy[Estimate]:
    return st.builds(Estimate, NUMBERS, NUMBERS, st.none() | st.tuples(NUMBERS, NUMBERS), NAMES)


def rankings() -> st.SearchStrategy[Ranked]:
    values = st.dictionaries(NAMES, NUMBERS, max_size=2)
    params = st.dictionaries(NAMES, estimates(), max_size=2)
    return st.builds(Ranked, NAMES, params, values, NUMBERS, NUMBERS, NUMBERS, st.booleans())


def remainders() -> st.SearchStrategy[Remainder]:
    region = st.none() | st.builds(Region, NAMES, NUMBERS, NUMBERS)
    return st.builds(Remainder, NAMES, NUMBERS, NAMES, NUMBERS, region)


def diagnoses() -> st.SearchStrategy[Diagnosis]:
    named = st.lists(NAMES, max_size=2).map(tuple)
    many = st.dictionaries(NAMES, NUMBERS, max_size=2)
    effect = many.map(lambda values: {"name": "delay:u", **values} | {"name": "delay:u"})
    finite = effect.map(lambda e: {k: v for k, v in e.items() if k == "name" or math.isfinite(v)})
    made = st.builds(Made, named, st.lists(finite, max_size=2).map(tuple), st.none() | many, many)
    return st.builds(
        Diagnosis,
        verdict=st.builds(Verdict, NAMES, named, named),
        where=st.builds(Where, whiteness=many),
        ranking=st.lists(rankings(), max_size=2).map(tuple),
        gap=st.builds(Gap, NUMBERS, NAMES, NUMBERS, NUMBERS, NUMBERS, st.booleans()),
        leftover=st.lists(remainders(), max_size=2).map(tuple),
        parameters=st.dictionaries(NAMES, estimates(), max_size=2),
        made=st.none() | made,
        probe=NAMES,
    )


@settings(suppress_health_check=[HealthCheck.too_slow])  # on a busy machine
@given(diagnoses())
def test_whatever_the_numbers_nothing_is_lost(found):
    read = again(found)
    assert read == found and read.to_json() == found.to_json()
    assert read.verdict == found.verdict and read.made == found.made
    for one, other in zip(read.ranking, found.ranking, strict=True):
        assert isinstance(one.evidence, float) and one.params.keys() == other.params.keys()
        assert one.evidence == other.evidence or not math.isfinite(other.evidence)


def test_an_older_document_is_read_with_what_it_has():
    found = Diagnosis.from_json(DIAGNOSIS)
    assert found.made is None and found.probe == "" and not found.ranking[0].claimed
    assert found.values("viscous_friction:v") == {"k": 0.3}
    assert again(found) == found
    oldest = Diagnosis.from_json({"verdict": {"kind": "none"}})
    assert not oldest.gap.measured and math.isnan(oldest.gap.before) and oldest.ranking == ()
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


def test_values_of_an_effect_that_is_not_there_are_an_error_that_names_what_is():
    found = Diagnosis.from_json(DIAGNOSIS)
    with pytest.raises(GroundedError, match=r"'drag:v'.*viscous_friction:v"):
        found.values("drag:v")
    with pytest.raises(GroundedError, match="no value"):
        Diagnosis.from_json({"verdict": {"kind": "none"}}).values("drag:v")
