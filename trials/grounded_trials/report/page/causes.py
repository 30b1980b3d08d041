"""The page's list of what was adopted and of what is wrong: an item each, with values and worth."""

from __future__ import annotations

from dataclasses import dataclass

from grounded.diagnosis.cause_words import OWN, give_or_take, with_worth
from grounded.diagnosis.error_report import CALIBRATION
from grounded.diagnosis.report import Diagnosis
from grounded.diagnosis.tables import values_of
from grounded.result import begun, listed
from grounded_trials.report.settled import Settled


@dataclass(frozen=True)
class Cause:
    """An item: what is wrong in words, the name for `adopt`, its values with their +-.

    ties: (name, values) of each effect that these trials cannot tell from it.
    """

    text: str
    name: str
    values: str
    ties: tuple[tuple[str, str], ...] = ()


def causes(diagnosis: Diagnosis) -> list[Cause]:
    """Return an item per cause, the largest first; a single one is told above, in words."""
    if diagnosis.no_cause or len(diagnosis.verdict.causes) != len(diagnosis.credit):
        return []  # the latter: a document of an older version
    found, several = [], len(diagnosis.credit) > 1
    for text, one in zip(diagnosis.verdict.causes, diagnosis.credit, strict=True):
        said = with_worth(begun(text), [one]) if several else ""
        if one.of == CALIBRATION:
            found.append(Cause(said, OWN, _calibrated(diagnosis)))
        elif (row := diagnosis.ranked(one.of)) is not None:
            found.append(Cause(said, one.of, values_of(row), _ties(diagnosis, one.of)))
    return found


def _ties(diagnosis: Diagnosis, effect: str) -> tuple[tuple[str, str], ...]:
    groups = [group for group in diagnosis.indistinguishable if effect in group]
    others = dict.fromkeys(name for group in groups for name in group if name != effect)
    rows = {name: diagnosis.ranked(name) for name in others}
    return tuple((name, "" if row is None else values_of(row)) for name, row in rows.items())


def adopted(settled: Settled | None) -> list[Cause]:
    """Return an item for each adopted effect and parameter; none for a single one, told above."""
    if settled is None or len(settled.adopted) < 2:
        return []
    both = zip(settled.adopted, settled.rows, strict=True)
    return [
        Cause("" if text.startswith(f"{name} ") else begun(text), name, values)
        for text, (name, values) in both
    ]


def _calibrated(diagnosis: Diagnosis) -> str:
    """Return the calibrated parameters that may be adopted; those that are off come first."""
    known, off = diagnosis.known_parameters, diagnosis.verdict.parameters
    names = [*(name for name in off if name in known), *(name for name in known if name not in off)]
    rests = diagnosis.conditions
    given = {n: f" given {listed(rests[n])}" if n in rests else "" for n in names}
    return ", ".join(f"{n} = {give_or_take(known[n])}{given[n]}" for n in names)
