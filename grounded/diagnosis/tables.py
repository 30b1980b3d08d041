"""A diagnosis in rows and lines, shared by terminal, page and notebook."""

from __future__ import annotations

import math
from collections.abc import Iterable
from html import escape

from grounded.accounts.finding import Finding
from grounded.diagnosis.cause_words import OWN, give_or_take, times_of
from grounded.diagnosis.error_report import CALIBRATION, TIMES, RulerRow, furthest
from grounded.diagnosis.parts import Diagnosed, Estimate, Ranked
from grounded.diagnosis.ruler_words import told_row
from grounded.result import figure, html_table, or_zero, percent, shown, with_unit

Cells = tuple[str, ...]
WIDEST = 1e4  # an interval wider than this times the value, and than UNBOUNDED, says nothing
UNBOUNDED = 1e6
INTERVAL = 2 * 1.96  # width of a 95 % interval in standard deviations
WITHOUT = "without: how much larger errors are without it, in the mean over states and horizons"
EFFECTS = 8  # rows of the table of effects, more if more are claimed or tied


def error_table(diagnosis: Diagnosed, *, whole_trials: bool = True) -> tuple[list[Cells], Cells]:
    """Return (rows, header) of the held-out prediction errors, in the units of the states.

    Args:
        diagnosis: the result.
        whole_trials: whether to add the errors over whole trials to those a horizon ahead. They
            are added in any case if the sentence gives them.
    """
    told = told_row(diagnosis.prediction_error)
    whole_trials = whole_trials or (told is not None and told.whole_trial)
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
    if any(row.floor_bound for row in ahead):
        columns["noise_floor"] = "noise, at most"
    few = diagnosis.no_cause  # values of one short log say nothing of another
    for key in ("outset", "calibrated"):
        if not any(getattr(row, key) for row in ahead) or (few and key == "calibrated"):
            del columns[key]
    told_rows = (*ahead, *(whole if whole_trials or not ahead else ()))

    def repeats_crude(key: str) -> bool:
        pairs = (
            (_cell(row, "crude", name), _cell(row, key, name))
            for row in told_rows
            for name in row.unit_by_channel
        )
        return all(now == then for now, then in pairs)

    if "calibrated" in columns and repeats_crude("calibrated"):  # no other parameters were likelier
        del columns["calibrated"]
    nothing_claimed = not diagnosis.verdict.causes and repeats_crude("with_effects")
    if few or nothing_claimed:
        del columns["with_effects"]
    rows: list[Cells] = []
    for row in told_rows:
        when = "whole trial" if row.whole_trial else f"{row.horizon_s:.3g} s ahead"
        for name, unit in row.unit_by_channel.items():
            if math.isnan(row.crude.get(name, math.nan)):
                continue  # the state has no sensor
            if not any(getattr(row, key).get(name) for key in columns):
                continue  # it never moved
            figures = (_cell(row, key, name) for key in columns)
            rows.append((f"{name}, {when}", *figures, shown(unit)))
    return rows, ("error (rms)", *columns.values(), "unit")


def _cell(row: RulerRow, column: str, name: str) -> str:
    value = or_zero(getattr(row, column).get(name, math.nan), row.crude.get(name, 0.0))
    if not row.tells(name, column):
        return "diverges"
    return figure(value, 3) if math.isfinite(value) else "-"


def credit_of(diagnosis: Diagnosed, effect: str) -> str:
    """Return how much larger errors are without a cause, `+7 %` or `2.4 times`; "" if unknown."""
    return next((larger(c.times) for c in diagnosis.credit if c.of == effect), "")


def larger(times: float) -> str:
    """Return `+7 %`, or `2.4 times` from a factor of 2 on; "" for NaN."""
    if math.isnan(times):  # a document of an older version
        return ""
    return f"+{percent(times - 1)}" if times < 2 else times_of(times)


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
        if one.log and one.log in one.advice:  # says when to set it
            lines.append(f"{one.signal}: {one.finding}{done}. {one.advice}")
            continue
        more = f"; to correct it for good, set {one.log} in its table of [log]" * bool(one.log)
        more += f"; {one.advice}" * bool(one.advice)
        lines.append(f"{one.signal}: {one.finding}{done}{more}")
    return lines


def effect_table(diagnosis: Diagnosed, *, rivals: bool = True) -> tuple[list[Cells], Cells]:
    """Return (rows, header) of the effects that were compared, the claimed ones first.

    Every claimed effect and every tied one has a row; rivals fill the table up to EFFECTS rows. The
    evidence of a rival is what it gains alone, so it has a column of its own.

    Args:
        diagnosis: the result.
        rivals: whether to list effects that are neither claimed nor tied with a claimed one.
    """
    beside = weighed_beside(diagnosis)
    own = [r for r in diagnosis.ranking if r.effect in beside]
    others = [r for r in diagnosis.ranking if r.effect not in beside] if rivals else []
    others = others[: max(EFFECTS - len(own), 0)]
    columns = 2 if others else 1  # of evidence
    rows: list[Cells] = [
        (
            ("* " if r.claimed else "  ") + r.effect,
            credit_of(diagnosis, r.effect),
            *((_evidence(r), "") if r in own else ("", _evidence(r)))[:columns],
            values_of(r),
        )
        for r in (*own, *others)
    ]
    if rows and (share := credit_of(diagnosis, CALIBRATION)):
        blank = ("", "")[:columns]
        rows.insert(0, ("  (calibration)", share, *blank, OWN))
    evidence = ("evidence [nats]", "alone [nats]")[:columns]
    return rows, ("effect (*: claimed)", "without", *evidence, "value")


def of_rivals(diagnosis: Diagnosed) -> str:
    """Say what the evidence of an effect that was not claimed means; "" if there is none."""
    beside = weighed_beside(diagnosis)
    if all(row.effect in beside for row in diagnosis.ranking):
        return ""
    text = "log-likelihood less that of the likeliest model without effects; negative where "
    text += "parameters alone explain more"
    if not any(row.claimed for row in diagnosis.ranking):
        return f"alone: its {text}"
    return f"alone: in place of what is claimed, its {text}; beside that, it gains too little"


def of_delays(diagnosis: Diagnosed) -> str:
    """Say where the +- of times comes from, if it is not from the noise.

    The rows of a log may not tell when a command was sent, and states may be interpolated. "" if
    neither is so, or if no such time is claimed.
    """
    made, why = diagnosis.made, list[str]()
    claimed = [row.effect.partition(":")[0] for row in diagnosis.ranking if row.claimed]
    if made is None:
        return ""
    if made.rows_s and "delay" in claimed:
        why.append(
            f"+- of a delay: mostly half of the {made.rows_s:.3g} s between rows of the log, which "
            "do not say when in between a command was sent"
        )
    if made.interpolated_s and (TIMES.keys() & claimed or credit_of(diagnosis, CALIBRATION)):
        why.append(f"+- of times: {in_between(made.interpolated_s)}")
    return "; ".join(why)


def in_between(seconds: float) -> str:
    """Say by how much times are uncertain since states were interpolated."""
    return (
        f"at least {1e3 * seconds:.2g} ms, since states were interpolated between the samples of "
        "the log, where a response may begin early"
    )


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
    unknown = {
        name
        for name, e in row.params.items()
        if math.isfinite(e.std) and undetermined(INTERVAL * e.std, e.value)
    }
    if unknown and unknown == set(row.params):
        return "its values are not determined"
    return ", ".join(
        f"{name} is not determined" if name in unknown else f"{name} = {_value(e)}"
        for name, e in row.params.items()
    )


def undetermined(width: float, value: float) -> bool:
    """Return whether a 95 % interval is so wide that the value means nothing."""
    return width > max(WIDEST * abs(value), UNBOUNDED)


def _value(e: Estimate) -> str:
    if not math.isfinite(e.std):
        return with_unit(f"{figure(e.value, 3)} (any value fits)", e.unit)
    return give_or_take(e) if e.std else with_unit(figure(e.value, 3), e.unit)


def as_html(diagnosis: Diagnosed, everything: str) -> str:
    """Return HTML for a notebook: verdict, sensors, errors and effects; the rest is folded.

    Args:
        diagnosis: the result; `.plot()` draws it.
        everything: the whole document as HTML.
    """
    said = "".join(f"<p>{escape(line)}</p>" for line in diagnosis.verdict.lines)
    parts = [f"<b>{escape(diagnosis.kind)}</b>{said}"]
    if sensors := instrument_lines(diagnosis.preflight):
        parts.append(f"<b>Sensors</b><ul>{''.join(f'<li>{escape(s)}</li>' for s in sensors)}</ul>")
    if diagnosis.prediction_error and not diagnosis.no_cause:
        parts.append(html_table(*error_table(diagnosis)))
    if diagnosis.ranking and not diagnosis.no_cause:
        parts.append(html_table(*effect_table(diagnosis)))
    if diagnosis.next_trial:
        parts.append(f"<p><b>Next trial</b>: {escape(diagnosis.next_trial)}</p>")
    parts.append(f"<details><summary>The whole document</summary>{everything}</details>")
    return "".join(parts)
