"""A diagnosis and its document are one: written and read back, nothing is lost."""

import json
import math
from typing import Any

import pytest

from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.parts import Diagnosis, Made
from grounded.effects import Library
from grounded.errors import GroundedError
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
