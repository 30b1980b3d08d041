"""The page says what the terminal says of a diagnosis: causes, values with +-, hedges, caveats."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from grounded.diagnosis.report import Diagnosis
from grounded.diagnosis.tables import effect_table
from grounded.figures.figure import typeset
from grounded_trials.report.diagnosis_notes import note_lines
from grounded_trials.report.diagnosis_words import verdict_lines
from grounded_trials.report.gathering import gather
from grounded_trials.report.page.causes import adopted, causes
from grounded_trials.report.page.page import page
from grounded_trials.report.settled import Settled
from grounded_trials.report.three_lines import three_lines
from grounded_trials.workspace.folder import Folder
from reported import DIAGNOSIS, cart
from small_tasks import cart_task

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


class _Text(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.parts: list[str] = []

    def handle_data(self, data: str) -> None:
        self.parts.append(data)


def _words(html: str) -> str:
    reader = _Text()
    reader.feed(html)
    return _plain(" ".join(reader.parts))


def _plain(text: str) -> str:
    """Return a text as it reads: with single blanks and the page's signs."""
    return re.sub(r"\s+", " ", str(typeset(text)).replace("\xa0", " ").replace("\u2060", ""))


def test_the_page_has_every_sentence_value_and_note_of_the_terminal(cart, diagnosis):
    findings = replace(gather(Folder(cart)), diagnosis=diagnosis)
    text = _words(page(findings).split('<script type="application/json"')[0])
    told, others = verdict_lines(diagnosis)
    notes = [words for _, words in note_lines(diagnosis, findings.values)]
    values = [row[-1] for row in effect_table(diagnosis, rivals=False)[0] if "+-" in row[-1]]
    assert len(values) == 2 and any("copy of t0001" in note for note in notes)
    for words in (*told, *others, *notes, *values):
        assert _plain(words) in text
    for one in diagnosis.unconfirmed:
        assert _plain(one.sentence()) in text


def test_each_cause_is_an_item_with_its_worth_values_and_ties(diagnosis):
    own, friction = causes(diagnosis)
    assert "8.0 times" in own.text and "mass = 1.400 +- 0.020 kg" in own.values
    assert "46 %" in friction.text and "uncertain" in friction.text
    assert (friction.name, friction.values) == ("viscous_friction:v", "k = 0.300 +- 0.010 1/s")
    assert friction.ties == (("quadratic_drag:v", "k = 0.250 +- 0.020 1/m"),)


def test_above_a_list_of_causes_the_first_line_is_short_but_keeps_its_hedge(diagnosis):
    short, long = (three_lines(diagnosis, cart_task(), causes_below=b)[0] for b in (True, False))
    assert CAUSES[1] in long and CAUSES[1] not in short and "mass" not in short
    assert "unless the gap" in short and "8.0 times" in short


def test_a_single_cause_is_told_once(diagnosis):
    verdict = replace(diagnosis.verdict, causes=CAUSES[1:])
    one = replace(diagnosis, verdict=verdict, credit=diagnosis.credit[1:])
    assert [(c.text, c.name) for c in causes(one)] == [("", "viscous_friction:v")]
    assert CAUSES[1][1:] in three_lines(one, cart_task(), causes_below=True)[0]


def test_what_was_adopted_is_a_list_if_it_is_more_than_one():
    rows = (("viscous_friction:v", "k = 0.30 +- 0.01 1/s"), ("mass", "1.40 +- 0.02 kg, was 1"))
    both = Settled(("friction slows v", "mass 1.00 -> 1.40 kg"), rows=rows)
    friction, mass = adopted(both)
    assert friction.text and friction.values == rows[0][1]
    assert (mass.text, mass.name, mass.values) == ("", *rows[1])
    assert adopted(Settled(("friction slows v",), rows=rows[:1])) == adopted(None) == []
