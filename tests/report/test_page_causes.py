"""The page says what the terminal says of a diagnosis: causes, values with +-, hedges, caveats."""

from __future__ import annotations

import pytest

from grounded.diagnosis.report import Diagnosis
from grounded_trials.report.page.causes import adopted, causes
from grounded_trials.report.settled import Settled
from reported import DIAGNOSIS, cart

__all__ = ["cart"]
CAUSES = (
    "the model's own parameters are off: mass should be 1.400 +- 0.020 kg, unless the gap that "
    "remains is the reason",
    "the speed v is opposed by a friction of 0.3 1/s, but its size is uncertain",
)
SEEN = [
    {"effect": "dead_zone:force", "meaning": f"the force {what}", "trial": "t0002", "from": 0.1}
    | {"to": 0.4, "seen": [1, 3]}
    for what in ("sticks", "slips")
]


@pytest.fixture
def diagnosis() -> Diagnosis:
    """Two causes, a tie with values, two unconfirmed effects, and a caveat."""
    tied = {"k": {"value": 0.25, "std": 0.02, "unit": "1/m"}}
    ranking = [one | {"claimed": k == 0} for k, one in enumerate(DIAGNOSIS["ranking"])]
    ranking.append({"effect": "quadratic_drag:v", "params": tied, "evidence": 39.0})
    said = {
        "kind": "several",
        "effects": ["viscous_friction:v"],
        "parameters": ["mass"],
        "causes": CAUSES,
        "sentences": ["Both.", "The data can't tell two from each other.", "Unconfirmed: sticks."],
    }
    credit = [
        {"of": "calibration", "share": 0.7, "times": 8.0},
        {"of": "viscous_friction:v", "share": 0.3, "times": 1.46},
    ]
    more = {"verdict": said, "credit": credit, "ranking": ranking, "unconfirmed": SEEN}
    return Diagnosis.from_json(DIAGNOSIS | more | {"unknowable": ["t0002 is a copy of t0001"]})


def test_each_cause_is_an_item_with_its_worth_values_and_ties(diagnosis):
    own, friction = causes(diagnosis)
    assert "8.0 times" in own.text and "mass = 1.400 +- 0.020 kg" in own.values
    assert "46 %" in friction.text and "uncertain" in friction.text
    assert (friction.name, friction.values) == ("viscous_friction:v", "k = 0.300 +- 0.010 1/s")
    assert friction.ties == (("quadratic_drag:v", "k = 0.250 +- 0.020 1/m"),)


def test_what_was_adopted_is_a_list_if_it_is_more_than_one():
    rows = (("viscous_friction:v", "k = 0.30 +- 0.01 1/s"), ("mass", "1.40 +- 0.02 kg, was 1"))
    both = Settled(("friction slows v", "mass 1.00 -> 1.40 kg"), rows=rows)
    friction, mass = adopted(both)
    assert friction.text and friction.values == rows[0][1]
    assert (mass.text, mass.name, mass.values) == ("", *rows[1])
    assert adopted(Settled(("friction slows v",), rows=rows[:1])) == adopted(None) == []
