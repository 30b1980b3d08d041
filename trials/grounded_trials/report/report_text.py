"""The report for a terminal: 80 columns, aligned numbers, the next command as its last line."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from grounded.errors import NextCommand
from grounded.search.difference import Difference
from grounded.search.pictures import few
from grounded_trials.report.findings import (
    Findings,
    by_state,
    compared,
    off_prediction,
    off_target,
    rms,
    selection,
)
from grounded_trials.report.forecast import forecast_error
from grounded_trials.wording import (
    count,
    figure,
    folded,
    legend,
    per_second,
    rendered,
    wrapped,
)
from grounded_trials.workspace.candidates.proposing import not_counted
from grounded_trials.workspace.next_step import DIAGNOSE

ROWS, SPARED = 12, 3  # candidates in the table; more than so many others are counted
ITERATIONS = 5  # of the bias
LEGEND = "alpha: the part of the step that was run; +-: standard error"

Table = Callable[[Sequence[Sequence[str]], Sequence[str]], str]


def report_text(findings: Findings, table: Table, bars: Callable[[Sequence[float]], str]) -> str:
    """The whole report.

    Args:
        findings: what is shown.
        table: aligns rows under a header.
        bars: a sparkline of utilities.
    """
    parts = [_head(findings), _utilities(findings, table, bars)]
    if findings.best is not None:
        parts += [_trajectories(findings, table), _biases(findings, table)]
    parts.append(_diagnosis(findings, table))
    if findings.logs:
        parts.append(_logs(findings, table))
    if findings.lost:
        lines = ["left out"]
        for one in findings.lost:
            lines += _wrapped(f"{one.file}: {one.reason}")
        parts.append("\n".join(lines))
    parts.append(folded(rendered(findings.then, findings.folder)))
    return "\n\n".join(parts)


def _head(findings: Findings) -> str:
    task = findings.task
    text = (
        f"{findings.name}: {task.model.name}, {task.horizon} steps of {task.dt:g} s "
        f"({task.horizon * task.dt:g} s), {'closed loop' if task.feedback else 'open loop'}; "
        f"{count(len(findings.runs) + findings.left_runs, 'trial')}"
    )
    if findings.logs:
        text += f", {count(len(findings.logs) + findings.left_logs, 'log')} of data"
    text += "".join(f"; {one.sentence}" for one in not_counted(findings.uncounted))
    if findings.discarded:
        text += f", set aside: {', '.join(findings.discarded)}"
    if findings.effects:
        text += "; adopted: " + ", ".join(findings.effects)
    return "\n".join(wrapped(text, "", ""))


def _utilities(findings: Findings, table: Table, bars: Callable[[Sequence[float]], str]) -> str:
    history = findings.history
    if not history:
        return "utility\n  -"
    shown, left = few(history, ROWS if len(history) > ROWS + SPARED else len(history))
    rows = [(*row[:3], *row[4:]) for row in map(findings.standing.row, shown)]  # without damping
    header = ("candidate", "iter.", "alpha", "predicted", "real", "+-", "trials", "")
    lines = [
        "utility",
        table(rows, header),
        *_wrapped(legend(LEGEND, [t.candidate.iteration for t in shown])),
    ]
    if left:
        status = rendered(NextCommand("status"), findings.folder)
        lines += _wrapped(f"({left} more: {status})")
    if spark := bars([t.utility for t in history if t.utilities]):
        lines += ["", *_wrapped(spark)]
    first, best = findings.first, findings.best
    if first is not None and best is not None:
        text = f"model's policy {figure(first.utility)}, "
        text += f"best {best.candidate.id} {figure(best.utility)}"
        own = best.candidate.id == first.candidate.id  # it leads no other
        if math.isfinite(first.utility) and first.utility < 0 and not own:
            tried = {one.candidate.id: one for one in history}
            two = tried[first.candidate.id], tried[best.candidate.id]
            text += f"; {Difference(*two, history).lead.sentence}"
        if findings.optimum is not None:
            text += f", optimum {figure(findings.optimum)}"
        lines += _wrapped(text)
    if less := findings.standing.less_in_log:
        lines += _wrapped(less.sentence)
    lines += _wrapped(f"{findings.standing.outcome}: {findings.outlook}")
    return "\n".join(lines)


def _trajectories(findings: Findings, table: Table) -> str:
    """Distance to the target, and what the model had promised, rms over the run."""
    task, runs = findings.task, [run for _, run in compared(findings)]
    columns = [rms(off_target(findings, run)) for run in runs]
    columns += [rms(off_prediction(findings, run)) for run in runs]
    rows = by_state(task.model, columns)
    ids = [run.candidate.id for run in runs]
    header = ("state", "unit", *(f"{i} off" for i in ids), *(f"{i} gap" for i in ids))
    return "\n".join(["trajectories, rms", table(rows, header)])


def _biases(findings: Findings, table: Table) -> str:
    task = findings.task
    runs = selection(findings.improvements, ITERATIONS)
    if not runs:
        return "bias\n  -"
    rows = by_state(task.model, [rms(run.residual) / task.dt for run in runs], per_second)
    header = ("state", "unit", *(run.candidate.id for run in runs))
    return "bias, rms\n" + table(rows, header)


def _diagnosis(findings: Findings, table: Table) -> str:
    if findings.diagnosis is None:
        told = rendered(DIAGNOSE, findings.folder)
        return "\n".join(["gap to the model", *_wrapped(told)])
    lines = ["gap to the model", *(part for line in findings.lines for part in _wrapped(line))]
    if (said := findings.told) is not None and said.rows:
        lines += ["", table(said.rows, said.header)]
    return "\n".join(lines)


def _logs(findings: Findings, table: Table) -> str:
    """How far the crude model is off so far ahead (`ahead_s`) in logs that ran no candidate."""
    logs = findings.logs[-ITERATIONS:]
    ahead = findings.ahead_s
    columns = [forecast_error(findings.crude, log.trial, ahead) for log in logs]
    rows = by_state(findings.task.model, columns)
    title = f"data: rms error {ahead:.3g} s ahead"
    return "\n".join([*wrapped(title, "", "  "), ""]) + table(
        rows, ("state", "unit", *(log.trial.id for log in logs))
    )


def _wrapped(text: str) -> list[str]:
    return wrapped(text, "  ", "    ")
