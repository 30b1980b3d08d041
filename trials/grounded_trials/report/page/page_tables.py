"""The page's pieces: its tables, figures with their legends, commands to copy, and colours.

Every text goes through `escape`: names come from strangers' files too.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from html import escape

from grounded.diagnosis.report import Diagnosis, Estimate, Ranked
from grounded_trials.report.figures.draw import draw, svg
from grounded_trials.report.figures.figure import COLOURS, DASHES, Figure, Key
from grounded_trials.report.findings import (
    Findings,
    by_state,
    compared,
    prediction_error,
    rms,
    standard_error,
    tracking_error,
)
from grounded_trials.report.forecast import SECONDS, forecast_error
from grounded_trials.wording import figure, shown, with_unit
from grounded_trials.workspace.next_step import Since

WIDEST = 1e6  # an interval so many times its value, or so wide, says nothing
UNKNOWN = "–, not determined by these trials"


def candidate_table(findings: Findings) -> str:
    """Every candidate with its trials."""
    rows, best = [], findings.standing.incumbent
    for tried in findings.history:
        c = tried.candidate
        cells = {
            "candidate": c.id,
            "iteration": str(c.iteration),
            "alpha": f"{c.alpha:g}",
            "damping": f"{c.damping:.2g}" if c.base else "-",
            "predicted utility": figure(c.predicted_utility),
            "real utility": figure(tried.utility),
            "std. error": figure(standard_error(tried), 2),
            "verdict ": tried.verdict(tried is findings.history[-1]),
            "trials ": " ".join(t.id for t in tried.trials) or "none",
        }
        rows.append(cells)
    strong = {k for k, t in enumerate(findings.history) if best and t.candidate is best.candidate}
    return table("candidates", list(rows[0]), [list(cells.values()) for cells in rows], strong)


def error_table(findings: Findings) -> str:
    """Rms by state: off the target, off the prediction, and the bias."""
    task, runs = findings.task, [run for _, run in compared(findings)]
    if findings.best is None:
        return ""
    columns = {f"off target, {r.candidate.id}": rms(tracking_error(task, r.trial)) for r in runs}
    columns |= {f"off prediction, {r.candidate.id}": rms(prediction_error(task, r)) for r in runs}
    columns |= {f"bias per s, {r.candidate.id}": rms(r.residual) / task.dt for r in runs}
    rows = by_state(task.model, [*columns.values()])
    return table("errors", ("state", "unit", *columns), rows)


def forecast_table(findings: Findings) -> str:
    """Rms error of the model 1 s ahead, by state, for the best run and every log."""
    best = findings.best or findings.latest
    trials = ([best.trial] if best is not None else []) + [log.trial for log in findings.logs]
    if not trials:
        return ""
    planners = [("without adopted effects" if findings.effects else "crude", findings.crude)]
    if findings.better is not None:
        planners.append((findings.better.name, findings.better.planner))
    names = [f"{t.id or t.candidate}, {words}" for t in trials for words, _ in planners]
    columns = [forecast_error(planner, t) for t in trials for _, planner in planners]
    title = f"<h3>Error of the model {SECONDS:g} s ahead, rms</h3>"
    rows = by_state(findings.task.model, columns)
    return title + table("forecasts", ("state", "unit", *names), rows)


def effect_table(diagnosis: Diagnosis, since: Since) -> str:
    """The ranked effects with their parameters and 95 % intervals."""
    rows = [
        (
            r.effect + " (adopted since)" * (r.effect in since.adopted),
            figure(r.evidence, 3),
            figure(r.gap_after, 3),
            _hundredths(r.shrinkage),
            _params(r),
        )
        for r in diagnosis.ranking
    ]
    header = ("effect", "evidence [nats]", "gap after", "gap closed", "parameters, 95 % ")
    strong = {i for i, r in enumerate(diagnosis.ranking) if r.effect in diagnosis.effects}
    return table("effects", header, rows, strong)


def _params(ranked: Ranked) -> str:
    texts = []
    for name, value in ranked.params.items():
        text = _interval(value)
        texts.append(f"{name} = {text if text == UNKNOWN else with_unit(text, value.unit)}")
    return "; ".join(texts) or "-"


def _interval(v: Estimate) -> str:
    """A value and its 95 % interval as the diagnosis has it; a dash where there is none."""
    if v.interval is None:
        return figure(v.value)
    low, high = v.interval
    known = low <= v.value <= high and high - low < WIDEST * max(abs(v.value), 1.0)
    return f"{figure(v.value)} ({figure(low, 3)} to {figure(high, 3)})" if known else UNKNOWN


def _hundredths(share: float) -> str:
    return f"{100 * share:.0f} %" if math.isfinite(share) else "-"


def leftover_table(diagnosis: Diagnosis) -> str:
    """What no known effect explains."""
    rows = [
        (
            left.channel,
            with_unit(figure(left.size, 3), left.unit),
            "-" if left.region is None else left.region.when,
            "-" if left.region is None else _hundredths(left.region.share),
            figure(left.evidence, 3),
        )
        for left in diagnosis.leftover
    ]
    header = ("channel", "missing rate, rms", "mostly where ", "share there", "evidence [nats]")
    return table("leftover", header, rows)


def parameter_table(findings: Findings) -> str:
    """The model's parameters, and what the diagnosis would make of them."""
    estimated = findings.diagnosis.parameters if findings.diagnosis is not None else {}
    rows = []
    for name, param in findings.task.model.params.items():
        nominal = findings.nominal.get(name)
        changed = "-" if nominal == param.value else figure(nominal)
        free = param.low is None and param.high is None
        limits = "free" if free else _range(param.low, param.high)
        found = _interval(estimated[name]) if name in estimated else "-"
        rows.append((name, figure(param.value), shown(param.unit), changed, limits, found))
    if not rows:
        return "<p>The model has no parameters.</p>"
    header = ("parameter", "value", "unit", "in model.py", "bounds", "diagnosed, 95 %")
    return table("parameters", header, rows)


def channel_table(findings: Findings) -> str:
    """States and inputs with units, weights, limits and latency."""
    task, reward, rows = findings.task, findings.task.reward, []
    assert task.latency is not None
    for i, (name, unit) in enumerate(task.model.states.items()):
        weight = f"{reward.state[i]:g}"
        weight += f", terminal {reward.terminal[i]:g}" if reward.terminal[i] else ""
        rows.append((name, "state", shown(unit), weight, "-", "-"))
    for j, (name, unit) in enumerate(task.model.inputs.items()):
        weight = f"{reward.input[j]:g}, change {reward.input_change[j]:g}"
        delay = f"{task.latency[j]:g} s" if task.latency[j] else "-"
        rows.append((name, "input", shown(unit), weight, _range(task.low[j], task.high[j]), delay))
    return table("channels", ("name", "kind", "unit", "weight", "limits", "latency"), rows)


def _range(low: float | None, high: float | None) -> str:
    a = "−∞" if low is None or not math.isfinite(low) else f"{low:g}"
    b = "∞" if high is None or not math.isfinite(high) else f"{high:g}"
    return f"{a} to {b}"


def table(
    identity: str,
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    strong: Collection[int] = (),
) -> str:
    """A table with a button that copies it; text columns have a header that ends with a blank."""
    kinds = [' class="text"' if name.endswith(" ") else "" for name in header]
    head = "".join(f"<th{k}>{escape(h.strip())}</th>" for h, k in zip(header, kinds, strict=True))
    lines = []
    for number, row in enumerate(rows):
        cells = "".join(f"<td{k}>{escape(c)}</td>" for c, k in zip(row, kinds, strict=True))
        lines.append(f"<tr{' class=strong' if number in strong else ''}>{cells}</tr>")
    return (
        f'<div class="wide"><table id="{identity}"><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>"
        f'<button type="button" data-copy="{identity}">copy table</button>'
    )


def figure_block(figure: Figure | None, columns: str = "") -> str:
    """A figure's caption, legend and panels; nothing for None."""
    if figure is None:
        return ""
    keys = "".join(f"<li>{_key(key)}{escape(key.name)}</li>" for key in figure.key)
    panels = "".join(
        f"<div>{svg(draw(panel), f'{figure.name}-{number}')}</div>"
        for number, panel in enumerate(figure.panels)
    )
    caption = f'<p class="soft">{escape(figure.caption)}</p>' if figure.caption else ""
    legend = f'<ul class="key">{keys}</ul>' if keys else ""
    return f'{caption}{legend}<div class="panels {columns}">{panels}</div>'


def command(text: str, identity: str) -> str:
    """A command to type, with a button that copies it."""
    button = f'<button type="button" data-copy="{identity}">copy</button>'
    return f'<code id="{identity}">{escape(text)}</code> {button}'


def role_styles() -> str:
    """Colours and dashes of the roles, light and dark; print is light."""
    light = "".join(f".{role}{{--c:{pair[0]}}}" for role, pair in COLOURS.items())
    dark = "".join(f".{role}{{--c:{pair[1]}}}" for role, pair in COLOURS.items())
    dashes = "".join(
        f".{role}.line{{stroke-dasharray:{' '.join(f'{10 * v:g}' for v in lengths)}}}"
        for role, lengths in DASHES.items()
    )
    return f"{light}{dashes}@media screen and (prefers-color-scheme: dark){{{dark}}}"


MARKS = {  # of a legend, by the shape of its entry
    "line": '<path class="{} line" stroke-width="25" d="M0 60h260"/>',
    "dash": '<path class="{} line whole" stroke-width="25" d="M60 60h140"/>',
    "cross": '<path class="{} line" stroke-width="20" d="M85 15l90 90m0-90l-90 90"/>',
    "band": '<rect class="{} fill" fill-opacity="0.3" width="260" height="120"/>',
    "disc": '<circle class="{} fill" cx="130" cy="60" r="45"/>',
    "ring": '<circle class="{} hollow" cx="130" cy="60" r="45"/>',
}


def _key(key: Key) -> str:
    mark = MARKS[key.shape].format(key.role)
    return f'<svg viewBox="0 0 260 120" aria-hidden="true">{mark}</svg>'
