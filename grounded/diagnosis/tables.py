"""A diagnosis in rows: prediction errors, compared effects, faults of the sensors."""

from __future__ import annotations

import math
from collections.abc import Iterable

from grounded.accounts.finding import Finding
from grounded.diagnosis.error_report import RulerRow, furthest
from grounded.diagnosis.errors_told import telling
from grounded.diagnosis.parts import Diagnosed, Ranked
from grounded.result import figure, or_zero, percent, shown

Cells = tuple[str, ...]
COLUMNS = {
    "outset": "model.py",
    "crude": "model",
    "calibrated": "calibrated",
    "with_effects": "as diagnosed",
    "noise_floor": "noise",
}


def error_table(diagnosis: Diagnosed, *, whole_trials: bool = True) -> tuple[list[Cells], Cells]:
    """Return (rows, header) of the held-out prediction errors, in the units of the states.

    Args:
        diagnosis: the result.
        whole_trials: whether to add the errors over whole trials to those a horizon ahead. They
            are added in any case if these are told.
    """
    rows_of = diagnosis.prediction_error
    row = telling(rows_of)
    ahead = [one for one in [furthest(rows_of)] if one]
    whole = [one for one in rows_of if one.whole_trial]
    if not (whole_trials or not ahead or (row is not None and row.whole_trial)):
        whole = []
    shown_rows = (*ahead, *whole)
    columns = columns_told(diagnosis)
    rows: list[Cells] = []
    for one in shown_rows:
        when = "whole trial" if one.whole_trial else f"{one.horizon_s:.3g} s ahead"
        for name, unit in one.unit_by_channel.items():
            known = not math.isnan(one.crude.get(name, math.nan))  # else it has no sensor
            if known and any(getattr(one, key).get(name) for key in columns):  # else it never moved
                figures = (_cell(one, key, name) for key in columns)
                rows.append((f"{name}, {when}", *figures, shown(unit)))
    return rows, ("error (rms)", *columns.values(), "unit")


def columns_told(diagnosis: Diagnosed) -> dict[str, str]:
    """Return the columns of `RulerRow` that are told, with their names."""
    rows, columns = diagnosis.prediction_error, dict(COLUMNS)
    if not any(row.outset for row in rows):
        del columns["outset"]
    if diagnosis.no_cause or not diagnosis.verdict.causes:  # what was fitted is no finding
        del columns["calibrated"], columns["with_effects"]
    elif not any(row.calibrated for row in rows):
        del columns["calibrated"]
    columns["noise_floor"] += ", at most" * any(row.floor_bound for row in rows)
    return columns


def _cell(row: RulerRow, column: str, name: str) -> str:
    value = or_zero(getattr(row, column).get(name, math.nan), row.crude.get(name, 0.0))
    if not row.tells(name, column):
        return "diverges"
    return figure(value, 3) if math.isfinite(value) else "-"


def larger(times: float) -> str:
    """Return `+7 %`, or `2.4 times` from a factor of 2 on; "" for NaN."""
    if math.isnan(times):  # a document of an older version
        return ""
    if times < 2:
        return f"+{percent(times - 1)}"
    return f"{float(f'{times:.2g}'):,g} times"


def instrument_lines(findings: Iterable[Finding]) -> list[str]:
    """Return a line per sensor finding: the signal, the finding, and how to correct it for good.

    A signal that is not used gets one line, with its delay in it: nothing of it is corrected here.
    """
    findings = list(findings)
    further = {one.signal: f"; {one.finding}" for one in findings if one.source and one.delay_s}
    lines, findings = [], [one for one in findings if not (one.source and one.delay_s)]
    unused = {one.signal: one for one in findings if one.kind == "smoothed"}
    late = {one.signal for one in findings if one.kind == "delay"}
    for one in findings:
        left_out = unused.get(one.signal)
        if left_out and (one.kind == "lag" or (one is left_out and one.signal in late)):
            continue  # `left_out` says how old it is, or is said with the delay
        old = further.get(one.signal, "")  # beside what is said of its position
        cut = one.kind == "unresolved"  # says so itself
        done = "; corrected here" * (one.corrected and not (left_out or cut))
        if left_out and one.kind == "delay":
            done = f"; {left_out.finding}"
        done += old
        if one.mend is not None and "log" in one.mend.facts:  # says when to set it
            lines.append(f"{one.signal}: {one.finding}{done}. {one.advice}")
            continue
        more = f"; to correct it for good, set {one.log} in its table of [log]" * bool(one.log)
        more += f"; {one.advice}" * bool(one.advice)
        lines.append(f"{one.signal}: {one.finding}{done}{more}")
    return lines


def effect_table(diagnosis: Diagnosed) -> tuple[list[Cells], Cells]:
    """Return (rows, header) of the effects that were compared, the claimed ones first.

    Evidence is what is lost without an effect that is claimed or tied; `alone` is what another one
    gains in place of all claimed ones.
    """
    beside = weighed_beside(diagnosis)
    rows: list[Cells] = [
        (
            ("* " if r.claimed else "  ") + r.effect,
            *((_evidence(r), "") if r.effect in beside else ("", _evidence(r))),
            values_of(r),
        )
        for r in diagnosis.ranking
    ]
    return rows, ("effect (*: claimed)", "evidence [nats]", "alone [nats]", "value")


def weighed_beside(diagnosis: Diagnosed) -> set[str]:
    """Return the effects whose evidence is what is lost without them: claimed or tied with these.

    That of the other ranked effects is what they gain alone.
    """
    tied = {name for group in diagnosis.indistinguishable for name in group}
    return tied | {row.effect for row in diagnosis.ranking if row.claimed}


def _evidence(row: Ranked) -> str:
    decimals = int(abs(row.evidence) < 1000)
    return "-" if math.isnan(row.evidence) else f"{row.evidence:,.{decimals}f}"


def values_of(row: Ranked) -> str:
    """Format the quantities of an effect with their standard deviations and units."""
    return ", ".join(
        f"{name} = {e.text if e.known else 'unknown'}" for name, e in row.params.items()
    )
