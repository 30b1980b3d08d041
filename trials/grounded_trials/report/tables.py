"""The contents of a report as values: sentences, tables, figures, commands.

The page's template lays them out and escapes every text, since names may come from untrusted
files; the report for a terminal and the recording take the same sentences and tables.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from grounded.diagnosis.telling import effect_table
from grounded.diagnosis.telling import error_table as held_out_table
from grounded.errors import NextCommand
from grounded.figures.figure import Figure
from grounded.result import begun, measured_alike
from grounded.search.difference import Difference, last_gain
from grounded.search.pictures import MOST_DRAWN, few
from grounded_trials.report.figures.paths import crash
from grounded_trials.report.figures.runs import all_figures
from grounded_trials.report.findings import (
    Findings,
    compared,
    measures,
)
from grounded_trials.wording import (
    count,
    figure,
    legend,
    or_zero,
    rendered,
    shown,
)
from grounded_trials.workspace.next_step import DIAGNOSE
from grounded_trials.workspace.off_target import off_target_of

MEASURES = {  # of a run, see `measures`
    "tracking_error": "off target",
    "prediction_error": "off prediction",
    "bias_rate": "bias in 1 s",
}
AHEAD = ("forecast", "data-")  # names of figures of forecasts
OPEN = 12  # largest number of candidates whose table is shown unfolded


@dataclass(frozen=True)
class Block:
    """A part of a section; `kind` selects its layout.

    text, soft, heading    a sentence
    command                a command to copy; `name` is its id
    table                  `name`, `header` (text columns end with a blank), `rows`; `strong` rows
                           are bold
    figure                 `figure`; with `wide` two panels per row
    folded                 `blocks` under the title `text`; open if `wide`
    run                    the slider that moves along the paths
    """

    kind: str
    text: str = ""
    name: str = ""
    header: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    strong: frozenset[int] = frozenset()
    figure: Figure | None = None
    blocks: Sequence[Block] = ()
    wide: bool = False


def table(
    name: str, header: Sequence[str], rows: Sequence[Sequence[str]], strong: Iterable[int] = ()
) -> Block:
    """Return a table that can be copied."""
    return Block("table", name=name, header=header, rows=rows, strong=frozenset(strong))


def _drawn(figure: Figure | None, wide: bool = False, title: bool = False) -> list[Block]:
    """Return a figure's blocks, with its title as a heading if `title`; [] for None."""
    if figure is None:
        return []
    heading = [Block("heading", figure.title)] if title else []
    return [*heading, Block("figure", name=figure.name, figure=figure, wide=wide)]


# what a report begins with


def about(findings: Findings) -> str:
    """Return the task in a line, and how it is searched."""
    task = findings.task
    return (
        f"{task.model.name}: {task.horizon} steps of {task.dt:g} s ({task.horizon * task.dt:g} s), "
        f"{'closed loop' if task.feedback else 'open loop'}; {findings.method}"
    )


def counted(findings: Findings) -> list[str]:
    """Return how many trials there are, and which ended early."""
    now, logs = findings.standing, len(findings.logs)
    found = []
    if findings.history or not logs:
        found.append(f"{count(now.trials, 'trial')}, {count(now.iteration, 'improvement')}")
    if logs:
        found.append(f"{count(logs, 'log')} of data")
    early = [run.trial.id for run in findings.runs if crash(run) is not None]
    return [*found, f"ended early: {', '.join(early)}"] if early else found


def improved(findings: Findings) -> list[tuple[str, str]]:
    """Return rows (value, text) of the errors and utility of the first and the best trial.

    The errors are those of `status`: rms over the run, and at the end where that is to be reached.
    Both are in one unit, lengths below 1 m in mm.
    """
    rows, task = list[tuple[str, str]](), findings.task
    runs = [[one.trial for one in findings.runs_of(r.candidate.id)] for _, r in compared(findings)]
    errors = [{one.what: one for one in off_target_of(task, own)} for own in runs]
    short = [t.id for own in runs for t in own if t.finite_steps < task.horizon]
    note = f"; {', '.join(short)} ended early" if short else ""
    for what, last in errors[-1].items() if errors else ():
        for kind in ("rms", "end"):
            values = [getattr(each[what], kind) for each in errors if what in each]
            if math.isfinite(values[-1]):
                texts = measured_alike([v for v in values if math.isfinite(v)], shown(last.unit))
                rows.append((" -> ".join(texts), f"{what} off target, {kind}{note}"))

    # the utility
    tried = [findings.tried_of(run) for _, run in compared(findings)]
    if findings.best is None:
        return rows
    first, best = tried[0].utility, tried[-1].utility
    names = [one.candidate.id for one in tried]
    if figure(first) == figure(best):
        return [*rows, (figure(best), f"utility, {names[-1]}")]
    gain = ""
    if -math.inf < first < 0 and best <= 0:
        gain = f": {Difference(tried[0], tried[-1], findings.history).lead.sentence}"
    return [*rows, (f"{figure(first)} -> {figure(best)}", f"utility, {' to '.join(names)}{gain}")]


# sections


def sections(findings: Findings) -> list[tuple[str, list[Block]]]:
    """Return the page's sections (title, parts) in reading order, without empty ones."""
    figures = {one.name: one for one in all_figures(findings)}
    paths = _drawn(figures.get("paths"), wide=True)
    found = [
        ("Paths", [Block("run"), *paths] if paths and findings.runs else paths),
        ("States", _drawn(figures.get("states"))),
        ("Inputs", _drawn(figures.get("inputs"))),
        ("Tracking error", _drawn(figures.get("error")) + error_table(findings)),
        ("Utility", _utility(findings, figures)),
        ("Bias", _drawn(figures.get("bias"))),
        ("Gap: model against reality", _gap(findings, figures)),
        ("Task and model", _task(findings)),
    ]
    return [(title, blocks) for title, blocks in found if blocks]


def _utility(findings: Findings, figures: Mapping[str, Figure]) -> list[Block]:
    if not findings.history:
        return []
    gain = last_gain(findings.history)
    sure = gain.to_finding().sentence if gain else ""
    wide = len(findings.history) <= OPEN
    return [
        *_drawn(figures.get("utility")),
        *([Block("text", f"{begun(sure)}.")] if sure else []),
        Block("folded", "All candidates", blocks=_candidates(findings), wide=wide),
    ]


def _gap(findings: Findings, figures: Mapping[str, Figure]) -> list[Block]:
    """Errors of predictions, forecasts of the crude model beside the better one; then details."""
    diagnosis = findings.diagnosis
    accuracy, shown = figures.get("accuracy"), (n for n in figures if n.startswith(AHEAD))
    ahead = [block for name in shown for block in _drawn(figures[name], title=True)]
    if diagnosis is None:
        command = Block("command", rendered(DIAGNOSE, findings.folder), "c-diagnose")
        return [command, *ahead]
    if diagnosis.no_cause:  # with too little data, what was fitted is no finding
        return ahead
    found = [*_drawn(accuracy, title=True), *ahead]
    found += _titled("Errors of held-out predictions", "held-out", *held_out_table(diagnosis))
    return found + _titled("Effects that were compared", "effects", *effect_table(diagnosis))


def _titled(
    title: str, name: str, rows: Sequence[Sequence[str]], header: Sequence[str]
) -> list[Block]:
    """Return a table under its title; [] without rows."""
    return [Block("heading", title), table(name, header, rows)] if rows else []


def _task(findings: Findings) -> list[Block]:
    words = f"Adopted: {', '.join(findings.effects) or 'none'}."
    parameters = Block("folded", "Parameters", blocks=parameter_table(findings))
    return [Block("text", words), parameters]


# tables


def _candidates(findings: Findings) -> list[Block]:
    """Return the candidates with their trials; of many, a part and the number left out."""
    now = findings.standing
    best, header = now.incumbent, (*now.table()[1][:-1], "verdict ", "from", "trials ")
    kept, left = few(findings.history, MOST_DRAWN)
    rows = [
        (*now.row(one), one.candidate.base or "-", " ".join(t.id for t in one.trials) or "none")
        for one in kept
    ]
    strong = {k for k, t in enumerate(kept) if best and t.candidate is best.candidate}
    made = table("candidates", header, rows, strong)
    status = rendered(NextCommand("status"), findings.folder)
    more = [Block("text", f"{left} more"), Block("command", status, "c-status")] * bool(left)
    why = legend("", [t.candidate.iteration for t in kept])
    return [made, *([Block("soft", f"{begun(why)}.")] if why else []), *more]


def error_table(findings: Findings) -> list[Block]:
    """Return by state the rms errors from target and prediction, and the rms bias."""
    task, runs = findings.task, [run for _, run in compared(findings)]
    if findings.best is None:
        return []
    each = [(run.candidate.id, measures(findings, run)) for run in runs]
    columns = {f"{what}, {of}": own[k] for k, what in MEASURES.items() for of, own in each}
    rows = [
        (name, shown(unit), *(figure(or_zero(value, *values), 3) for value in values))
        for (name, unit), *values in zip(
            task.model.states.items(), *(c.tolist() for c in columns.values()), strict=True
        )
    ]
    return [table("errors", ("state", "unit", *columns), rows)]


def parameter_table(findings: Findings) -> list[Block]:
    """Return the model's parameters: in model.py, now, and as the last diagnosis has them."""
    found = findings.diagnosis.parameters if findings.diagnosis else {}
    rows = [
        (
            name,
            figure(findings.nominal.get(name)),
            figure(param.value),
            found[name].text if name in found else "-",
            shown(param.unit),
        )
        for name, param in findings.task.model.params.items()
    ]
    header = ("parameter", "in model.py", "now", "diagnosed ", "unit")
    return [table("parameters", header, rows)] if rows else []
