"""The catalogue: every entry is printed with sample facts; `settle` orders and hides."""

from __future__ import annotations

import re
from fnmatch import fnmatchcase

import pytest

from grounded.findings import Quantity, Weight, catalogue, found, settle
from grounded.findings.numbers import filled

SLOT = re.compile(r"\{(\w+)(?::([^{}]*))?\}")
LONGEST = 400  # characters of a sentence with all its clauses, five lines of a terminal
ENTRIES = [(code, catalogue.entry_of(code)) for code in catalogue.codes()]


def sample(text: str) -> dict:
    """Return facts of the right type for the slots of a text."""
    facts: dict = {}
    for name, how in SLOT.findall(text):
        if "=" in how:
            facts[name] = how.split("=")[0]
        elif how in ("", None):
            facts.setdefault(name, ("v", "yaw") if name == "about" else "v")
        elif how == "size":
            facts[name] = Quantity(0.012, "m")
        else:
            facts[name] = 2 if "/" in how or how.isalpha() else 0.25
    return facts


@pytest.mark.parametrize(("code", "entry"), ENTRIES, ids=[code for code, _ in ENTRIES])
def test_every_entry_prints(code, entry):
    text = f"{entry.short}; {entry.remedy}" if entry.remedy else entry.short
    said = filled(text, sample(text))
    assert entry.weight in set(Weight)
    assert len(said) <= LONGEST and not said.endswith(".") and "  " not in said
    assert not re.search(r"[{}]|\[\[|\]\]|\bs\^2 m\b", said)
    assert said.count("`") % 2 == 0 and said.count("(") == said.count(")")
    conditions = dict.fromkeys(re.findall(r"\[\[!?(\w+)\?", text), True)
    whole = filled(text, conditions | sample(text))
    assert "  " not in whole and not re.search(r"\[\[|\]\]", whole), whole
    for hidden in entry.hides:
        assert any(fnmatchcase(other, hidden) for other, _ in ENTRIES), hidden


@pytest.mark.parametrize(
    ("text", "facts", "said"),
    [
        ("{a} late", {"a": Quantity(0.0512, "s", 0.0021)}, "0.0512 +- 0.0021 s late"),
        ("off by {a:size}", {"a": Quantity(0.012, "m")}, "off by 12 mm"),
        ("{a:%} of {b:trial}", {"a": 0.254, "b": ("t1", "t2")}, "25 % of 2 trials"),
        ("{b} {b:is/are} late", {"b": ("x",)}, "x is late"),
        ("{b} {b:is/are} late", {"b": ("x", "y")}, "x and y are late"),
        ("it is {a:low=too low,high=too high}", {"a": "high"}, "it is too high"),
        ("x[[, {a:.2g} times]]", {}, "x"),
        ("x[[, {a:.2g} times]]", {"a": 2.0}, "x, 2 times"),
    ],
)
def test_facts_are_formatted(text, facts, said):
    assert filled(text, facts) == said


def test_what_follows_from_another_is_not_told(monkeypatch):
    entries = {
        "log.a": catalogue.Entry("note", "a", hides=("log.b*",)),
        "log.b": catalogue.Entry("warn", "b"),
        "log.c": catalogue.Entry("warn", "c"),
    }
    monkeypatch.setattr(catalogue, "ENTRIES", entries)
    a, b, other = found("log.a", "x"), found("log.b", "x"), found("log.b", "y", nats=9.0)
    c = found("log.c", "x", nats=3.0)
    assert settle([a, c, b, other, c]) == (other, c, a)
    assert a.to_json()["code"] == "log.a" and a.to_json()["nats"] is None
