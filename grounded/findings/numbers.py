"""filled: a sentence of the catalogue with its facts, formatted in one place.

A slot is `{name}` or `{name:how}`:

    {name}             a text; a list as "a, b and c"; a quantity with its unit and its +-
    {name:size}        a length, angle or time in two digits, in mm, mrad or ms where it is small;
                       several of one unit in one prefix
    {name:%}           a share in per cent
    {name:trial}       a number (or the length of a list) with a noun: "1 trial", "3 trials"
    {name:is/are}      the first word for one, the second for several
    {name:low=too low,high=too high}   the words for a value
    {name:.3g}, {name:g}   a number by Python's format

`[[ ... ]]` is left out where a fact that it names is missing, None, empty, NaN or 0 as a number.
`[[name? ...]]` is kept where the fact `name` is none of these, `[[!name? ...]]` where it is one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import Any

from grounded.result import figure, listed, measured, measured_alike, percent, with_error, with_unit

_CLAUSE = re.compile(r"\[\[(.*?)\]\](?!\])", re.S)
_IF = re.compile(r"(!?)(\w+)\? ?")
_SLOT = re.compile(r"\{(\w+)(?::([^{}]*))?\}")


def filled(text: str, facts: Mapping[str, Any]) -> str:
    """Return a text with its slots filled and its clauses kept or left out.

    Args:
        text: a sentence of the catalogue.
        facts: values by slot.
    """

    def clause(match: re.Match[str]) -> str:
        test = _IF.match(match[1])
        text = match[1][test.end() :] if test else match[1]
        if test and _known(facts.get(test[2])) is bool(test[1]):
            return ""
        names = [name for name, _ in _SLOT.findall(text)]
        return text if all(_known(facts.get(name)) for name in names) else ""

    kept = _CLAUSE.sub(clause, text)
    sizes = _alike(facts, [name for name, how in _SLOT.findall(kept) if how == "size"])
    return _SLOT.sub(lambda m: sizes.get(m[1]) or shaped(facts[m[1]], m[2] or ""), kept)


def _alike(facts: Mapping[str, Any], names: Iterable[str]) -> dict[str, str]:
    """Return sizes of one unit in one prefix, since a sentence compares them."""
    by_unit: dict[str, list[str]] = {}
    for name in names:
        by_unit.setdefault(facts[name].unit, []).append(name)
    told: dict[str, str] = {}
    for unit, some in by_unit.items():
        if len(some) > 1:
            told |= zip(some, measured_alike([facts[n].value for n in some], unit), strict=True)
    return told


def bare(text: str) -> str:
    """Return a text to be read without facts: its slots as <name>, its clauses in brackets."""
    clauses = _CLAUSE.sub(lambda m: f"[{_IF.sub('', m[1], count=1).strip()}]", text)
    return _SLOT.sub(lambda m: m[2] if "/" in (m[2] or "") else f"<{m[1]}>", clauses)


def slots(text: str) -> set[str]:
    """Return the names of the slots that a text cannot do without."""
    return {name for name, _ in _SLOT.findall(_CLAUSE.sub("", text))}


def shaped(value: Any, how: str) -> str:
    """Return a fact as text, in one of the ways that the module lists."""
    number = getattr(value, "value", value)
    if "=" in how:
        words = dict(pair.split("=", 1) for pair in re.split(r",(?=\w+=)", how))
        return words.get(str(value), "")
    if isinstance(value, tuple | list | set | frozenset):
        if not how:
            return listed(map(str, value))
        number = len(value)
    if how == "%":
        return percent(number)
    if how == "size":
        return measured(number, value.unit)
    if "/" in how:
        one, several = how.split("/")
        return one if number == 1 else several
    if len(how) > 1 and how.replace(" ", "").isalpha():
        return f"{number} {how}{'s' * (number != 1)}"
    if how:
        return f"{number:{how}}"
    if hasattr(value, "unit"):
        known = math.isfinite(value.std) and value.std > 0
        text = with_error(number, value.std) if known else figure(number, 3)
        return with_unit(text, value.unit)
    return figure(value) if isinstance(value, float) else str(value)


def _known(value: Any) -> bool:
    number = getattr(value, "value", value)
    return bool(number) and not (isinstance(number, float) and math.isnan(number))
