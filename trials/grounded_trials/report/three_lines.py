"""The diagnosis in three lines: what was wrong, what predictions gain, what is still open."""

from __future__ import annotations

import math
from collections.abc import Mapping

from grounded.diagnosis.error_report import RulerRow, measured
from grounded.diagnosis.report import Diagnosis
from grounded.diagnosis.verdict import rest, told_apart, worsened
from grounded.task import Task
from grounded_trials.report.findings import weighed_groups
from grounded_trials.wording import count, shown

CAUSES = 2  # that the first line names
SMALL = 0.05  # of the gain: a cause below it is only counted
FEW = 2  # states in the second line


def three_lines(diagnosis: Diagnosis, task: Task) -> list[str]:
    """What was wrong, what predictions gain, what is still open; fewer where no cause is known.

    Args:
        diagnosis: what was found.
        task: whose weighed states the second line speaks of.
    """
    if not diagnosis.verdict.causes:
        return list(diagnosis.verdict.lines)
    return [_wrong(diagnosis), *_gained(diagnosis, task), _open(diagnosis)]


def _wrong(diagnosis: Diagnosis) -> str:
    """The largest causes without their shares, which the bars show; the others are counted."""
    told: list[str] = []
    small = 0
    for clause, credit in zip(diagnosis.verdict.causes, diagnosis.credit, strict=True):
        if told and (len(told) == CAUSES or credit.share < SMALL):
            small += 1
        else:
            told.append(clause)
    text = "; ".join(told) + f"; {count(small, 'smaller cause')}" * bool(small)
    return f"{text[:1].upper()}{text[1:]}."


def _gained(diagnosis: Diagnosis, task: Task) -> list[str]:
    """How far predictions are off now, and were: position first, in the units of the states."""
    row, parts = _ahead(diagnosis), []
    if row is None:
        return []
    for names, what in gained_most(diagnosis, task):
        unit = shown(row.unit_by_channel[names[0]])
        now, then = (_together(errors, names) for errors in (row.with_effects, row.crude))
        parts.append(f"{what} by {measured(now, unit)} instead of {measured(then, unit)}")
    held = "" if row.held_out != "no" else ", not held out"
    ahead = f"{row.horizon_s:.3g} s ahead{held}"
    told = [f"{ahead} it now misses {' and '.join(parts)}."] if parts else []
    if worse := worsened(diagnosis.prediction_error):
        told.append(worse)
    return [" ".join(told)] if told else []


def gained_most(diagnosis: Diagnosis, task: Task) -> list[tuple[list[str], str]]:
    """The weighed states that a verdict speaks of: the position, then what improved most."""
    row = _ahead(diagnosis)
    if row is None:
        return []
    groups = [g for g in weighed_groups(task) if all(row.crude.get(n, 0.0) > 0 for n in g[0])]
    return sorted(groups, key=lambda g: (len(g[0]) < 2, _ratio(row, g[0])))[:FEW]


def _ahead(diagnosis: Diagnosis) -> RulerRow | None:
    return next((r for r in reversed(diagnosis.prediction_error) if not r.whole_trial), None)


def _ratio(row: RulerRow, names: list[str]) -> float:
    return _together(row.with_effects, names) / _together(row.crude, names)


def _together(errors: Mapping[str, float], names: list[str]) -> float:
    return math.hypot(*(errors.get(name, math.nan) for name in names))


def _open(diagnosis: Diagnosis) -> str:
    """What ties, and what no known effect explains."""
    found = [told_apart(group, diagnosis.equivalent) for group in diagnosis.indistinguishable[:1]]
    found += [one.sentence() for one in diagnosis.unconfirmed[:1]]
    if diagnosis.leftover:
        others = len(diagnosis.leftover) - 1
        more = f"; {count(others, 'more state')}" * bool(others)
        found.append(f"still unexplained: {diagnosis.leftover[0].sentence()}{more}")
    text = "; ".join(found) or rest(diagnosis.prediction_error) or "nothing is left above the noise"
    return f"{text[:1].upper()}{text[1:]}."
