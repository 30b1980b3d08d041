"""The diagnosis in three lines: what was wrong, what predictions gain, what is still open."""

from __future__ import annotations

import math
from collections.abc import Mapping

from grounded.diagnosis.cause_words import with_worth
from grounded.diagnosis.error_report import CALIBRATION
from grounded.diagnosis.report import Diagnosis
from grounded.diagnosis.ruler_words import (
    COMPARABLE,
    SHOWS,
    in_doubt,
    open_noise,
    rest,
    telling,
    worsened,
)
from grounded.diagnosis.verdict import ONE_MOTION, OPEN, also_off, told_apart, told_of
from grounded.result import begun, listed, measured_alike
from grounded.task import Task
from grounded_trials.wording import shown
from grounded_trials.workspace.off_target import rates_among, weighed_groups

FEW = 2  # states in the second line


def three_lines(diagnosis: Diagnosis, task: Task, *, causes_below: bool = False) -> list[str]:
    """What was wrong, what predictions gain, what is still open; fewer where no cause is known.

    Args:
        diagnosis: what was found.
        task: whose weighed states the second line speaks of.
        causes_below: whether a list of all causes follows, so that the first line gives the largest
            of several and counts the others.
    """
    if not diagnosis.verdict.causes:
        return list(diagnosis.verdict.lines)
    better = [gained(diagnosis, task), worsened(diagnosis.prediction_error)]
    lines = [
        diagnosis.verdict.comparison,
        _largest(diagnosis) if causes_below else _wrong(diagnosis),
        " ".join(filter(None, better)),
        still_open(diagnosis),
    ]
    return [line for line in lines if line]


def _wrong(diagnosis: Diagnosis) -> str:
    """The causes, largest first, without what they are worth, which the bars show."""
    text = "; ".join(diagnosis.verdict.causes)
    return f"{begun(text)}."


def _largest(diagnosis: Diagnosis) -> str:
    """The largest cause, without values of calibrated parameters, and how many more there are."""
    causes, credit = diagnosis.verdict.causes, diagnosis.credit
    if len(causes) < 2 or not credit:
        return _wrong(diagnosis)
    first = causes[0]
    if credit[0].of == CALIBRATION:
        first = f"{first.partition(': ')[0]}{OPEN * (OPEN in first)}"
    more = "one smaller cause is" if len(causes) == 2 else f"{len(causes) - 1} smaller causes are"
    text = f"{with_worth(first, credit[:1])}; {more} listed below"
    return f"{begun(text)}."


def gained(
    diagnosis: Diagnosis,
    task: Task,
    now: str = "with_effects",
    before: str = "crude",
    who: str = "the diagnosed model",
) -> str:
    """How far predictions are off now, and were: position first, in the units of the states.

    Args:
        diagnosis: whose ruler says it.
        task: whose weighed states are spoken of.
        now: the column of `RulerRow` that holds today's errors.
        before: the column of those before; that of today says nothing of before.
        who: misses so much.
    """
    row, parts, same = telling(diagnosis.prediction_error), list[str](), list[str]()
    if row is None:
        return ""
    after, first = getattr(row, now), getattr(row, before)
    first = {name: error for name, error in first.items() if row.tells(name, now, before)}
    for names, what in _improved(after, first, task):
        unit = shown(row.unit_by_channel[names[0]])
        told = (after,) if now == before else (after, first)
        noise = [row.noise_floor.get(names[0], 0.0)] if len(names) == 1 else []  # as the verdict
        ends = measured_alike([*(_together(errors, names) for errors in told), *noise], unit)
        ends = ends[: len(told)]
        equal = len(ends) > len({*ends})  # as printed: that says nothing beside others
        (same if equal else parts).append(f"{what} by {' instead of '.join(ends)}")
    parts = parts or same
    held = "" if row.held_out != "no" else " (not held out)"
    ahead = f"{'Over whole trials' if row.whole_trial else f'{row.horizon_s:.3g} s ahead'}"
    return f"{ahead} {who} misses {listed(parts)}{held}." if parts else ""


def gained_most(diagnosis: Diagnosis, task: Task) -> list[tuple[list[str], str]]:
    """The states that a verdict speaks of: the position, then what improved most of the weighed.

    If no weighed state improved so much that the verdict names it, those that did.
    """
    row = telling(diagnosis.prediction_error)
    if row is None:
        return []
    crude = {n: e for n, e in row.crude.items() if row.tells(n, "crude", "with_effects")}
    return _improved(row.with_effects, crude, task)


def _improved(
    now: Mapping[str, float], before: Mapping[str, float], task: Task
) -> list[tuple[list[str], str]]:
    groups = [g for g in weighed_groups(task) if all(before.get(n, 0.0) > 0 for n in g[0])]
    ratio = {what: _together(now, names) / _together(before, names) for names, what in groups}
    if min(ratio.values(), default=0.0) > 1 - SHOWS:  # a speed alone, which has no weight
        others = {n: now[n] / error for n, error in before.items() if error > 0}
        others = {n: of for n, of in others.items() if of < 1 - SHOWS}
        ratio = others or ratio
        groups = [([n], n) for n in others] or groups
    best = min(ratio.values(), default=0.0)
    rates = {g[1] for g, rate in zip(groups, rates_among(task, groups), strict=True) if rate}

    def order(group: tuple[list[str], str]) -> tuple[bool, bool, bool, float]:
        names, what = group
        return len(names) < 2, ratio[what] > best + COMPARABLE, what in rates, ratio[what]

    return sorted(groups, key=order)[:FEW]


def _together(errors: Mapping[str, float], names: list[str]) -> float:
    return math.hypot(*(errors.get(name, math.nan) for name in names))


def still_open(diagnosis: Diagnosis, *, ties: bool = True, repeated: bool = False) -> str:
    """What ties (unless `ties` is False), and what no known effect explains.

    Args:
        diagnosis: what was found.
        ties: whether effects that the trials can't tell apart are told.
        repeated: whether a run was repeated since, which tells the noise that was not known.
    """
    same, claimed = diagnosis.equivalent, diagnosis.effects
    groups = diagnosis.indistinguishable if ties else ()
    alike = [told_apart(group, same, claimed) for group in groups]
    found = [f"{text[:1].lower()}{text[1:]}" for text in alike]
    found += [one.sentence() for one in told_of(diagnosis.unconfirmed)]
    if diagnosis.leftover:
        more = also_off(len(diagnosis.leftover) - 1)
        found.append(f"still unexplained: {diagnosis.leftover[0].sentence()}{more}")
    rows = diagnosis.prediction_error
    if not found and (name := open_noise(rows)):
        tells = "a new diagnosis" if repeated else "only a repeat of one run"
        found.append(f"{tells} tells how much of what is left in {name} is noise")
    nothing = in_doubt(rows) or "nothing is left above the noise"
    if worsened(rows):  # which is said elsewhere
        nothing = "it is open why predictions get worse with it there"
    if not diagnosis.leftover and (small := rest(rows)):
        found.append(small)
    text = "; ".join(found) or nothing
    one = f" {ONE_MOTION}" * (ONE_MOTION in diagnosis.verdict.lines)
    return f"{begun(text)}.{one}"
