"""told: a diagnosis as lines, a table of causes, findings and the next step; its figures.

Terminal, report, page, notebook and recording take all of it from here. The words stand in the
catalogue (`gap`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from grounded.accounts.finding import Finding as Fault
from grounded.diagnosis.error_report import (
    CALIBRATION,
    TOLD,
    RulerRow,
    errors,
    excess,
    furthest,
    states_told,
    telling,
)
from grounded.diagnosis.levels import ABOVE, SHOWS
from grounded.figures import Figure, Panel, curve, panel
from grounded.findings import Finding, Quantity, found, settle
from grounded.findings.catalogue import entry_of
from grounded.result import figure, measured, number, or_zero, percent, shown

if TYPE_CHECKING:  # of which this is a part
    from grounded.diagnosis.parts import Diagnosis, Ranked

NEXT = "gap.next."  # before the codes of next steps
LINES = frozenset(  # codes of the lines, which are made from the facts
    f"gap.{name}" for name in ("causes", "none", "unknown", "too_few", "errors", "left", "where")
)
FINDINGS = 3  # told beside the lines; the others with --details


@dataclass(frozen=True)
class Told:
    """What is told of a diagnosis: findings by role, and the table of its causes."""

    lines: tuple[Finding, ...]  # what, how good, and what is open
    rows: tuple[Cells, ...]
    header: Cells
    findings: tuple[Finding, ...]  # all others, the heaviest first
    next: str

    def texts(self, most: int | None = FINDINGS) -> list[str]:
        """Return the lines as sentences, and as many findings; None: all of them."""
        return [sentence(one) for one in (*self.lines, *self.findings[:most])]


def sentence(one: Finding) -> str:
    """Return a finding as a sentence of its own; names keep their small letter."""
    text, own = one.sentence, entry_of(one.code).short[:1].isalpha()
    return f"{text[:1].upper() if own else text[:1]}{text[1:]}."


def told(diagnosis: Diagnosis) -> Told:
    """Return what is told of a diagnosis."""
    rows, header = cause_table(diagnosis)
    rest = settle(one for one in diagnosis.findings if not one.code.startswith(NEXT))
    lines = (_what(diagnosis), *errors_line(diagnosis), *open_line(diagnosis))
    if diagnosis.no_cause:  # what was fitted then means nothing
        lines, rows = lines[:1], ()
    return Told(lines, rows, header, rest, diagnosis.next_trial)


def cause_table(diagnosis: Diagnosis) -> tuple[tuple[Cells, ...], Cells]:
    """Return rows and header of the causes, the largest first, each with what ties with it."""
    rows, own = list[Cells](), diagnosis.known_parameters
    for one in diagnosis.credit:
        row = diagnosis.ranked(one.of)
        values = "" if row is None else values_of(row)
        if one.of == CALIBRATION:
            names = [name for name in diagnosis.verdict.parameters if name in own]
            names += [name for name in diagnosis.adoptable if name not in names]
            texts = [(name, f"{own[name].text}{_was(diagnosis, name)}") for name in names]
            shares = (percent(one.share), *("" for _ in texts))
            rows += [(*text, share) for text, share in zip(texts, shares, strict=False)]
            continue
        rows.append((one.of, values, percent(one.share)))
        groups = [group for group in diagnosis.indistinguishable if one.of in group]
        for name in dict.fromkeys(name for group in groups for name in group if name != one.of):
            tied = diagnosis.ranked(name)
            rows.append((f"or {name}", "" if tied is None else values_of(tied), ""))
    return tuple(rows), ("cause", "value", "share")


def _was(d: Diagnosis, name: str) -> str:
    return f", was {number(d.made.nominal[name])}" if name in d.made.nominal else ""


def _what(d: Diagnosis) -> Finding:
    """The causes, or that there is none."""
    causes = d.verdict.causes or d.effects  # the latter: a document of an older version
    left = any(one.above for one in d.leftover)
    if d.no_cause:
        return found("gap.too_few")
    if causes:
        tied = any(name in group for group in d.indistinguishable for name in d.effects)
        more = len(causes) - TOLD
        words = "; ".join(causes[:TOLD])
        return found(
            "gap.causes", *d.effects, causes=words, more=max(more, 0), tied=tied, left=left
        )
    row = telling(d.prediction_error)
    if d.kind == "unknown":
        return found("gap.unknown", noise=not d.leftover, groups=bool(d.changed))
    known = row is not None and any(error > 0 for error in row.noise_floor.values())
    adopted = bool(d.made.adopted)
    return found("gap.none", known=known and not excess(d.prediction_error), adopted=adopted)


def errors_line(d: Diagnosis) -> Iterator[Finding]:
    """How far predictions are off, and were."""
    if (row := telling(d.prediction_error)) is None:
        return
    names = states_told(row, d.tracked)
    facts: dict[str, Any] = {}
    for end, name in zip(("", "2"), names, strict=False):
        facts |= errors(row, name, **{f"now{end}": "with_effects", f"before{end}": "crude"})
        pair = [facts.get(f"{slot}{end}", Quantity(math.nan)) for slot in ("now", "before")]
        if len({measured(one.value, one.unit) for one in pair}) == 1:
            facts.pop(f"before{end}", None)
    if "now" not in facts:
        return
    # beside an upper bound of the noise, an error within it would look like noise
    if not (row.floor_at_most and any(row.above.get(name, 0.0) <= ABOVE for name in names)):
        facts |= errors(row, names[0], noise="noise_floor")
    yield found(
        "gap.errors",
        *names,
        state=names[0],
        state2=names[1] if len(names) > 1 else None,
        whole=row.whole_trial,
        ahead=0.0 if row.whole_trial else row.horizon_s,
        who="it" if d.verdict.causes else "the model",
        bound="yes" if row.floor_at_most else "no",
        inside=row.held_out == "no",
        **facts,
    )


def open_line(d: Diagnosis) -> Iterator[Finding]:
    """What no known effect explains, or else where the gap is."""
    if d.leftover:
        left, place = d.leftover[0], None
        if left.region is not None and not left.part:
            place = left.region.told
        facts: dict[str, Any] = {"others": len(d.leftover) - 1, "place": place}
        if not math.isfinite(left.error) or (not left.above and math.isfinite(left.size)):
            size = Quantity(left.size, left.unit) if math.isfinite(left.size) else None
            facts |= {"rate": left.channel, "size": size}
        else:
            noise = Quantity(left.floor, left.error_unit) if 0 < left.floor < math.inf else None
            facts |= {"error": Quantity(left.error, left.error_unit), "ahead": left.horizon_s}
            facts |= {"state": left.channel, "noise": noise}
            facts |= {"bound": "yes" if left.floor_at_most else "no"}
            if left.part is not None:
                facts |= {"part": left.part.share, "trial": left.part.trial}
        yield found("gap.left", left.channel, **facts)
        return
    channels = [one for one in d.where.channels if SHOWS <= one.share < math.inf]  # NaN: only noise
    if not channels:
        return
    first, second, region = channels[0], channels[1:2], d.where.regions[:1]
    yield found(
        "gap.where",
        *(one.name for one in channels),
        state=first.name,
        share=first.share,
        state2=second[0].name if second else None,
        share2=second[0].share if second else None,
        part=region[0].share if region else None,
        place=region[0].told if region else None,
    )


Cells = tuple[str, ...]
COLUMNS = {
    "outset": "model.py",
    "crude": "model",
    "calibrated": "calibrated",
    "with_effects": "as diagnosed",
    "noise_floor": "noise",
}


def error_table(diagnosis: Diagnosis) -> tuple[list[Cells], Cells]:
    """Return (rows, header) of the held-out prediction errors, in the units of the states."""
    rows_of = diagnosis.prediction_error
    shown_rows = [one for one in rows_of if one is furthest(rows_of) or one.whole_trial]
    columns = columns_told(diagnosis)
    rows: list[Cells] = []
    for one in shown_rows:
        when = WHOLE if one.whole_trial else f"{one.horizon_s:.3g} s ahead"
        for name, unit in one.unit_by_channel.items():
            known = not math.isnan(one.crude.get(name, math.nan))  # else it has no sensor
            if known and any(getattr(one, key).get(name) for key in columns):  # else it never moved
                figures = (_cell(one, key, name) for key in columns)
                rows.append((f"{name}, {when}", *figures, shown(unit)))
    return rows, ("error (rms)", *columns.values(), "unit")


def columns_told(diagnosis: Diagnosis) -> dict[str, str]:
    """Return the columns of `RulerRow` that are told, with their names."""
    rows, columns = diagnosis.prediction_error, dict(COLUMNS)
    if not any(row.outset for row in rows):
        del columns["outset"]
    if diagnosis.no_cause or not diagnosis.verdict.causes:  # what was fitted is no finding
        del columns["calibrated"], columns["with_effects"]
    elif not any(row.calibrated for row in rows):
        del columns["calibrated"]
    columns["noise_floor"] += ", at most" * any(row.floor_at_most for row in rows)
    return columns


def _cell(row: RulerRow, column: str, name: str) -> str:
    value = or_zero(getattr(row, column).get(name, math.nan), row.crude.get(name, 0.0))
    if not row.tells(name, column):
        return "diverges"
    return figure(value, 3) if math.isfinite(value) else "-"


def instrument_lines(findings: Iterable[Fault]) -> list[str]:
    """Return a line per sensor finding: the signal, the finding, and how to correct it for good."""
    lines = []
    for one in findings:
        cut = one.kind in ("smoothed", "unresolved")  # is not used, which it says itself
        done = "; corrected here" * (one.corrected and not cut)
        more = f"; to correct it for good, set {one.log} in its table of [log]" * bool(one.log)
        more += f"; {one.advice}" * bool(one.advice)
        lines.append(f"{one.signal}: {one.finding}{done}{more}")
    return lines


def effect_table(diagnosis: Diagnosis) -> tuple[list[Cells], Cells]:
    """Return (rows, header) of the effects that were compared, the claimed ones first.

    Evidence is what is lost without an effect that is claimed or tied; `alone` is what another one
    gains in place of all claimed ones.
    """
    beside = {name for group in diagnosis.indistinguishable for name in group}
    beside |= {row.effect for row in diagnosis.ranking if row.claimed}
    rows: list[Cells] = [
        (
            ("* " if r.claimed else "  ") + r.effect,
            *((_evidence(r), "") if r.effect in beside else ("", _evidence(r))),
            values_of(r),
        )
        for r in diagnosis.ranking
    ]
    return rows, ("effect (*: claimed)", "evidence [nats]", "alone [nats]", "value")


def _evidence(row: Ranked) -> str:
    decimals = int(abs(row.evidence) < 1000)
    return "-" if math.isnan(row.evidence) else f"{row.evidence:,.{decimals}f}"


def values_of(row: Ranked) -> str:
    """Format the quantities of an effect with their standard deviations and units."""
    return ", ".join(
        f"{name} = {e.text if e.known else 'unknown'}" for name, e in row.params.items()
    )


WHOLE = "whole trial"
APART_BY = 2.0  # where errors over whole trials are drawn, in units of the longest horizon
ROLES = {  # of the columns of prediction errors
    "outset": "limit",
    "crude": "model",
    "calibrated": "step1",
    "with_effects": "best",
    "noise_floor": "other",
}


def accuracy_figure(diagnosis: Diagnosis) -> Figure | None:
    """Return the prediction errors without and with the diagnosis, in each state's unit.

    None if there are none, or if no cause can be named.
    """
    errors = diagnosis.prediction_error
    if diagnosis.no_cause or not errors:
        return None
    panels = _over_horizons(errors, columns_told(diagnosis))
    if not panels:
        return None
    caption = "" if errors[0].held_out != "no" else "not held out"
    return Figure("accuracy", "Predictions before and after", caption, panels)


def _over_horizons(errors: Sequence[RulerRow], columns: Mapping[str, str]) -> list[Panel]:
    """Return one panel per state: its error over the horizon, and apart, that of whole trials."""
    units = errors[0].unit_by_channel
    panels: list[Panel] = []
    apart = APART_BY * max((e.horizon_s for e in errors if not e.whole_trial), default=1.0)
    at = np.array([apart if e.whole_trial else e.horizon_s for e in errors])
    whole = np.array([e.whole_trial for e in errors])
    ticks = [
        (float(x), WHOLE.replace(" ", "\n") if w else f"{x:.3g}")
        for x, w in zip(at, whole, strict=True)
    ]
    for channel, unit in units.items():
        curves = []
        for key, name in columns.items():
            values = np.array([getattr(e, key).get(channel, math.nan) for e in errors], float)
            for rows, note in ((~whole, ""), (whole, WHOLE)):
                if (values[rows] > 0).any():  # the axis is logarithmic
                    style = "line" if rows.sum() > 1 and not note else "points"
                    x, y = at[rows], values[rows]
                    curves.append(curve(x, y, ROLES[key], name, 2.0, style=style, note=note))
        if curves:
            curves.sort(key=lambda one: one["meta"]["role"] != "other")  # noise is drawn behind
            unit = shown(unit)
            label, across = f"{channel} [{unit}]" if unit else channel, "predicted ahead [s]"
            panels.append(panel(label, across, unit, curves, log=True, x_ticks=ticks))
    return panels
