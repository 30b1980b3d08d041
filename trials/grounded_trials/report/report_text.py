"""The report for a terminal: 80 columns, aligned numbers, the next command as its last line."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from grounded.errors import NextCommand
from grounded.search.pictures import few
from grounded_trials.report.findings import Findings
from grounded_trials.report.tables import about, counted, error_table, improved
from grounded_trials.wording import folded, rendered, wrapped
from grounded_trials.workspace.next_step import DIAGNOSE

ROWS, SPARED = 12, 3  # candidates in the table; more than so many others are counted

Table = Callable[[Sequence[Sequence[str]], Sequence[str]], str]


def report_text(findings: Findings, table: Table, bars: Callable[[Sequence[float]], str]) -> str:
    """The whole report.

    Args:
        findings: what is shown.
        table: aligns rows under a header.
        bars: a sparkline of utilities.
    """
    now, history = findings.standing, findings.history

    # the task, its trials, and what became better
    head = [f"{findings.name}: {about(findings)}", "; ".join(counted(findings))]
    if findings.effects:
        head.append(f"adopted: {', '.join(findings.effects)}")
    lines = [line for text in head for line in wrapped(text, "", "  ")]
    lines += ["", *_indented(f"{value}: {what}" for value, what in improved(findings))]

    # the candidates
    if history:
        kept, left = few(history, ROWS if len(history) > ROWS + SPARED else len(history))
        lines += ["", table([now.row(one) for one in kept], now.table()[1])]
        more = f"({left} more: {rendered(NextCommand('status'), findings.folder)})"
        spark = bars([tried.utility for tried in history if tried.utilities])
        lines += _indented(filter(None, (more * bool(left), spark)))
    lines += _indented([f"{now.outcome}: {findings.outlook}"])

    # errors by state, and what was diagnosed
    for block in error_table(findings):
        lines += ["", table(block.rows, block.header)]
    gap = findings.lines or [rendered(DIAGNOSE, findings.folder)]
    lines += ["", "gap to the model", *_indented(gap)]
    if (said := findings.told) is not None and said.rows:
        lines += ["", table(said.rows, said.header)]
    if findings.lost:
        lines += ["", "left out", *_indented(f"{one.file}: {one.reason}" for one in findings.lost)]
    return "\n".join([*lines, "", folded(rendered(findings.then, findings.folder))])


def _indented(texts: Iterable[str]) -> list[str]:
    return [line for text in texts for line in wrapped(text, "  ", "    ")]
