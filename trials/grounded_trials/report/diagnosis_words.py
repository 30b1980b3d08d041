"""A diagnosis in sentences for terminal and page, beyond its verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from grounded.diagnosis.cause_words import ended, furthest_apart, give_or_take, value_of, with_worth
from grounded.diagnosis.error_report import Correction, Gap
from grounded.diagnosis.parts import Changed, Estimate
from grounded.diagnosis.report import Diagnosis
from grounded.result import begun, listed
from grounded_trials.wording import (
    ALONE,
    changed,
    count,
    figure,
    percent,
    ranges,
    with_unit,
)

DIVERGED = 100.0  # times the spread of measured utilities: larger errors are not stated
TERMS = 2  # of a sum in a sentence, the largest; a third is told if it is the last
MOST = 3  # parameters whose dependence on held ones is stated one by one


def error_lines(
    diagnosis: Diagnosis, before: Mapping[str, float], *, whole: bool = False
) -> list[tuple[str, str]]:
    """Return (title, text) of the details: calibrated parameters, utility, look-alikes.

    Empty if there were too few data to name a cause: what was fitted then is not a finding.

    Args:
        diagnosis: the result.
        before: values of the model's parameters before it.
        whole: whether to give all terms of long sums, as a page does.
    """
    if diagnosis.no_cause:
        return []
    found = []
    if text := calibrated_sentence(diagnosis, before):
        found.append(("parameters", text))
    if text := held_sentence(diagnosis, whole=whole):
        found.append(("held", text))
    if text := utility_sentence(diagnosis):
        found.append(("utility", text))
    for effect in dict.fromkeys(one.effect for one in diagnosis.lookalikes):
        like = [
            f"{one.like} {'reproduces ' * (k == 0)}{percent(one.share)}"
            for k, one in enumerate(o for o in diagnosis.lookalikes if o.effect == effect)
        ]
        found.append(("alike", f"{', '.join(like)} of the signal of {effect}"))
    return found


def made_from(diagnosis: Diagnosis) -> str:
    """Return `made from 6 trials, t0001 to t0006`."""
    names = diagnosis.made.trials if diagnosis.made is not None else ()
    number = count(len(names) or diagnosis.trials, "trial")
    return f"made from {number}{f', {ranges(names)}' * bool(names)}"


def correction_line(correction: Correction) -> str:
    """Describe a correction, which is not a cause."""
    over = listed(correction.over)
    gain = f"removes {percent(correction.held_out_gain)} of the held-out squared error"
    if not correction.adoptable:
        return f"a curve of {correction.channel} over {over} does not improve held-out predictions"
    name = f"correction:{correction.channel}, a curve over {over},"
    return f"{name} {gain}; it is no cause, but can be adopted"


def in_vain(diagnosis: Diagnosis) -> list[str]:
    """Return a sentence for each effect that is likely but improves no held-out prediction."""
    return [
        f"{row.effect} alone is likely ({figure(row.evidence, 3)} nats), but held-out predictions "
        "do not clearly improve with it"
        for row in diagnosis.ranking
        if row.no_better
    ]


def agreement_lines(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Return what changed between two groups of trials, or where trials disagree."""
    if diagnosis.changed is not None:
        adopted = diagnosis.made.effects if diagnosis.made is not None else ()
        rows = [
            (
                "changed",
                f"{value_of(one, adopted)} = {give_or_take(one.first)} in the first trials, "
                f"{give_or_take(one.second)} in the second ({figure(one.evidence, 3)} nats)",
            )
            for one in diagnosis.changed
        ]
        rows = rows or [("changed", "nothing that these trials could show")]
        same = [
            f"{value_of(one, adopted)}, by {give_or_take(_difference(one))}"
            for one in diagnosis.unchanged
        ]
        return [*rows, ("unchanged", f"within +-: {'; '.join(same)}")] if same else rows
    found = []
    for one in diagnosis.agreement:
        if not one.agrees:
            values = [v for v in diagnosis.per_trial if v.effect == one.effect]
            values = [v for v in values if v.quantity == one.quantity]
            low, high = furthest_apart(values)
            ends = (Estimate(v.value, v.std, unit=one.estimate.unit) for v in (low, high))
            lowest, highest = map(give_or_take, ends)
            text = (
                f"trials disagree on {one.quantity} of {one.effect}: {lowest} in {low.trial}, "
                f"{highest} in {high.trial}"
            )
            found.append(("agreement", text + f"; it {one.goes_with}" * bool(one.goes_with)))
    return found


def _difference(one: Changed) -> Estimate:
    by, std = one.second.value - one.first.value, math.hypot(one.first.std, one.second.std)
    return Estimate(by, std, unit=one.first.unit)


def gap_sentence(gap: Gap) -> str:
    """Return the gap before and after, with its unit."""
    held = "held out" if gap.held_out else "not held out, too few trials"
    return (
        f"{figure(gap.before, 3)} before, {figure(gap.after, 3)} after, {held}, in units of the "
        f"error that the filter's own noise would cause {gap.horizon_s:.3g} s ahead, which is "
        "not the noise of the tables; not comparable between two diagnoses"
    )


def calibrated_sentence(diagnosis: Diagnosis, before: Mapping[str, float]) -> str:
    """List all model parameters that were calibrated together with the effects."""
    if all(name.startswith("parameter:") for name in diagnosis.effects):
        return ""
    made = diagnosis.made
    moved, then = [], {**before, **(made.nominal if made is not None else {})}
    known, joint = diagnosis.known_parameters, diagnosis.jointly
    for name, e in diagnosis.parameters.items():
        old = then.get(name, math.nan)
        if abs(e.value - old) > 1e-6 * max(abs(e.value), abs(old)):
            change = abs(e.value - old) / abs(old) if old else math.inf
            more = "".join(f" ({text})" for text in ended(e, old))
            more += " (not identified, not adopted)" * (name not in known)
            more += ALONE * (name in joint)
            moved.append((-change, changed(name, old, e.value, e.unit) + more))
    named = ", ".join(text for _, text in sorted(moved))
    return f"calibrated with the effects: {named}" * bool(moved)


def _between(some: Sequence[float]) -> str:
    """Return `+0.5 to +2`, or one number if both would read alike."""
    return " to ".join(dict.fromkeys(f"{one:+.2g}" for one in (min(some), max(some))))


def _largest(given: Mapping[str, float], most: int) -> list[str]:
    """Return the terms of a sum, the largest first; more than `most` and one end with a remark."""
    order = sorted(given, key=lambda name: -abs(given[name]))
    shown = order if len(order) <= most + 1 else order[:most]
    parts = [f"{given[name]:+.2g} % with 1 % more {name}" for name in shown]
    return parts if len(shown) == len(order) else [*parts, "smaller terms"]


def held_sentence(diagnosis: Diagnosis, *, whole: bool = False) -> str:
    """Say which calibrated parameters depend on others that these trials cannot identify.

    Args:
        diagnosis: the result.
        whole: whether to give all terms of a sum; else the largest.
    """
    said, held = [], dict[str, list[float]]()
    for one in (one for one in diagnosis.identifiable if one.given):
        e = diagnosis.parameters.get(one.parameter)
        if e is None:
            continue
        for name, by in one.given.items():
            held.setdefault(name, []).append(by)
        parts = _largest(one.given, len(one.given) if whole else TERMS)
        free = with_unit(f"+- {figure(one.prior * one.left, 2)}", e.unit)
        said.append(f"{one.parameter} changes by {listed(parts)} ({free} if all are free)")
    if len(said) > MOST:
        said = [
            f"{count(len(some), 'other')} change{'s' * (len(some) == 1)} by {_between(some)} % "
            f"with 1 % more {name}"
            for name, some in held.items()
        ]
    told = f"these trials cannot identify {listed(held)}: the values hold for the model's own"
    return f"{told}; {', '.join(said)}" * bool(said)


def utility_sentence(diagnosis: Diagnosis) -> str:
    """Say how well the utilities of whole trials are predicted; "" if none was."""
    found = diagnosis.utility_prediction
    if found is None or not found.trials:
        return ""
    without, better = (_utility_error(v, found.spread) for v in (found.before, found.after))
    whole = count(found.trials, "whole trial")
    text = f"rms error of the predicted utility of {whole}: {without} by the model"
    if diagnosis.effects:
        text += f", {better} by the diagnosed one"
    if found.trials > 1:
        text += f"; the measured utilities vary by {figure(found.spread, 3)}"
    how = "; predicted open loop, though the trials ran with feedback"
    return text + how * found.feedback


def _utility_error(error: float, spread: float) -> str:
    """Format an error; of one far beyond the spread of real utilities, only that it diverges."""
    if not math.isfinite(error):
        return "without bound (it diverges)"
    if spread > 0 and error > DIVERGED * spread:
        return f"over {float(f'{DIVERGED * spread:.2g}'):,g} (it diverges)"
    return figure(error, 3)


def verdict_lines(diagnosis: Diagnosis) -> tuple[list[str], list[str]]:
    """Return the causes with their worth if there are several, then the other sentences.

    What changed between two groups of trials comes before the causes.
    """
    causes, told = diagnosis.verdict.causes, list(diagnosis.verdict.lines)
    if len(causes) < 2:
        return [], told
    each = zip(causes, diagnosis.credit, strict=True)
    clauses = diagnosis.verdict.clauses or tuple(with_worth(c, [one]) for c, one in each)
    first = [text for text in [diagnosis.verdict.comparison] if text]
    first += [begun(clause) for clause in clauses]
    return first, told[1 + bool(diagnosis.verdict.comparison) :]
