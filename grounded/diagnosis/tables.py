"""A diagnosis in rows and lines, the same in the terminal, on the page and in a notebook."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING

from grounded.diagnosis.error_report import RulerRow, furthest
from grounded.result import figure, percent, shown, with_unit

if TYPE_CHECKING:
    from grounded.diagnosis.report import Diagnosis, Ranked
    from grounded.instruments.finding import Finding

Cells = tuple[str, ...]
EFFECTS = 8  # rows of them


def error_table(diagnosis: Diagnosis) -> tuple[list[Cells], Cells]:
    """(rows, header): held-out prediction errors a second ahead and over whole trials, in units."""
    ahead = [row for row in [furthest(diagnosis.prediction_error)] if row]
    whole = [row for row in diagnosis.prediction_error if row.whole_trial]
    columns = {
        "outset": "model.py",
        "crude": "crude",
        "calibrated": "calibrated",
        "with_effects": "as diagnosed",
        "noise_floor": "noise",
    }
    if any(row.outset for row in ahead):
        columns["crude"] = "now"
    if any(row.floor_at_most for row in ahead):
        columns["noise_floor"] = "noise, at most"
    for key in ("outset", "calibrated"):
        if not any(getattr(row, key) for row in ahead):
            del columns[key]
    rows: list[Cells] = []
    for row in (*ahead, *whole):
        when = "whole trial" if row.whole_trial else f"{row.horizon_s:.3g} s ahead"
        for name, unit in row.unit_by_channel.items():
            if math.isnan(row.crude.get(name, math.nan)):
                continue  # never measured
            figures = (_cell(row, key, name) for key in columns)
            rows.append((f"{name}, {when}", *figures, shown(unit)))
    return rows, ("error (rms)", *columns.values(), "unit")


def _cell(row: RulerRow, column: str, name: str) -> str:
    value = getattr(row, column).get(name, math.nan)
    if not row.tells(name, column):
        return "runs away"
    return figure(value, 3) if math.isfinite(value) else "-"


def credit_of(diagnosis: Diagnosis, effect: str) -> str:
    """What predictions lose without a cause, in percent of what they gain; "" if it has none."""
    return next((percent(c.share) for c in diagnosis.credit if c.of == effect), "")


def instrument_lines(findings: Iterable[Finding]) -> list[str]:
    """Each finding with its signal, whether it was corrected, and what does so in the logs, too."""
    lines = []
    for one in findings:
        done = "; corrected here" * (one.corrected and one.kind != "smoothed")
        more = f", for good by {one.log} in its table of [log]" * bool(one.log)
        more += f"; {one.advice}" * bool(one.advice)
        lines.append(f"{one.signal}: {one.finding}{done}{more}")
    return lines


def effect_table(diagnosis: Diagnosis) -> tuple[list[Cells], Cells]:
    """(rows, header): what is claimed, and what else was weighed, likeliest first."""
    rows: list[Cells] = [
        (
            ("* " if r.claimed else "  ") + r.effect,
            credit_of(diagnosis, r.effect),
            "-" if math.isnan(r.evidence) else f"{r.evidence:,.{int(abs(r.evidence) < 1000)}f}",
            _values(r),
        )
        for r in diagnosis.ranking[:EFFECTS]
    ]
    if rows and (share := credit_of(diagnosis, "calibration")):
        rows.insert(0, ("  (calibration)", share, "", "the model's own parameters"))
    return rows, ("effect (*: claimed)", "credit", "evidence [nats]", "value")


def _values(row: Ranked) -> str:
    """The quantities of an effect, each with its standard deviation and unit."""
    return ", ".join(
        with_unit(f"{name} = {figure(e.value, 3)}{_spread(e.std)}", e.unit)
        for name, e in row.params.items()
    )


def _spread(std: float) -> str:
    if not math.isfinite(std):
        return " (any value fits)"
    return f" +- {figure(std, 2)}" if std else ""


def as_html(diagnosis: Diagnosis, everything: str) -> str:
    """What a notebook shows: the verdict, the sensors, errors and effects; the rest folded.

    Args:
        diagnosis: of which nothing is drawn here (`.plot()`).
        everything: its document as HTML.
    """
    said = "".join(f"<p>{escape(line)}</p>" for line in diagnosis.verdict.lines)
    parts = [f"<b>{escape(diagnosis.kind)}</b>{said}"]
    if sensors := instrument_lines(diagnosis.preflight):
        parts.append(f"<b>Sensors</b><ul>{''.join(f'<li>{escape(s)}</li>' for s in sensors)}</ul>")
    if diagnosis.prediction_error and not diagnosis.no_cause:
        parts.append(_html_table(*error_table(diagnosis)))
    if diagnosis.ranking and not diagnosis.no_cause:
        parts.append(_html_table(*effect_table(diagnosis)))
    if diagnosis.next_trial:
        parts.append(f"<p><b>Next trial</b>: {escape(diagnosis.next_trial)}</p>")
    parts.append(f"<details><summary>The whole document</summary>{everything}</details>")
    return "".join(parts)


def _html_table(rows: Sequence[Cells], header: Cells) -> str:
    head = "".join(f"<th style='text-align:left'>{escape(cell)}</th>" for cell in header)
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"
