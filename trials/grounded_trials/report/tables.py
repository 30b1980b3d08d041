"""Sentences and tables of a report, for page, terminal and recording."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from grounded.result import measured_alike
from grounded.search.difference import Difference
from grounded.search.pictures import MOST_DRAWN, few
from grounded_trials.report.figures.paths import crash
from grounded_trials.report.findings import Findings, compared, measures
from grounded_trials.wording import count, figure, or_zero, shown
from grounded_trials.workspace.off_target import off_target_of

MEASURES = {  # of a run, see `measures`
    "tracking_error": "off target",
    "prediction_error": "off prediction",
    "bias_rate": "bias in 1 s",
}


class Table(NamedTuple):
    """A table; the names of text columns end with a blank, `strong` rows are bold."""

    rows: Sequence[Sequence[str]]
    header: Sequence[str]
    strong: frozenset[int] = frozenset()


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


# tables


def candidate_table(findings: Findings) -> tuple[Table, int]:
    """Return the candidates with their trials, of many a part, and the number left out."""
    now = findings.standing
    best, header = now.incumbent, (*now.table()[1][:-1], "verdict ", "from", "trials ")
    kept, left = few(findings.history, MOST_DRAWN)
    rows = [
        (*now.row(one), one.candidate.base or "-", " ".join(t.id for t in one.trials) or "none")
        for one in kept
    ]
    strong = {k for k, t in enumerate(kept) if best and t.candidate is best.candidate}
    return Table(rows, header, frozenset(strong)), left


def error_table(findings: Findings) -> Table:
    """Return by state the rms errors from target and prediction, and the rms bias."""
    task, runs = findings.task, [run for _, run in compared(findings)]
    if findings.best is None:
        return Table((), ())
    each = [(run.candidate.id, measures(findings, run)) for run in runs]
    columns = {f"{what}, {of}": own[k] for k, what in MEASURES.items() for of, own in each}
    rows = [
        (name, shown(unit), *(figure(or_zero(value, *values), 3) for value in values))
        for (name, unit), *values in zip(
            task.model.states.items(), *(c.tolist() for c in columns.values()), strict=True
        )
    ]
    return Table(rows, ("state", "unit", *columns))


def parameter_table(findings: Findings) -> Table:
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
    return Table(rows, ("parameter", "in model.py", "now", "diagnosed ", "unit"))
