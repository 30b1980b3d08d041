"""The texts of a recording, in Markdown: what to run next, the diagnosis, and a summary."""

from __future__ import annotations

import re

from grounded.diagnosis.tables import larger
from grounded.figures.figure import typeset
from grounded_trials.report.figures.paths import crash
from grounded_trials.report.findings import Findings
from grounded_trials.report.settled import told
from grounded_trials.wording import count, figure, percent

BAR = 20  # characters of a bar of 100 % credit


def verdict(findings: Findings) -> str:
    """Return the next command, and the diagnosis in a few lines (Markdown)."""
    diagnosis, lines = findings.diagnosis, [f"next: `{findings.next_command}`\n"]
    if diagnosis is None:
        lines.append("not diagnosed yet\n")
    else:
        lines += [
            f"{_marked(line)}\n"
            for line in told(diagnosis, findings.task, findings.since, findings.settled)
        ]
    return "\n".join(lines)


def credit(findings: Findings) -> str:
    """Return what each cause is worth as a table with bars (Markdown); "" if there is none."""
    diagnosis = findings.diagnosis
    if diagnosis is None or not diagnosis.credit:
        return ""
    lines = ["| cause | errors without it | |", "|---|---|---|"]
    for one in diagnosis.credit:
        bar = "█" * max(1, round(BAR * one.share)) if one.share > 0 else ""
        lines.append(f"| {one.of} | {larger(one.times) or percent(one.share)} | {bar} |")
    return "\n".join(lines)


def _marked(text: str) -> str:
    """Return a text with ± and ², and with the names of tables as code: lines broke after [."""
    return str(typeset(re.sub(r"\[\w+\]", "`\\g<0>`", text)))


def summary(findings: Findings) -> str:
    """Return a summary of the workspace and of what is left out (Markdown)."""
    task, best, first = findings.task, findings.best, findings.first
    left = findings.left_runs + findings.left_logs
    lines = [
        f"**{findings.name}**, {task.model.name}: {task.horizon} steps of {task.dt:g} s, "
        f"{count(len(findings.runs), 'trial')}"
        + f", {count(len(findings.logs), 'log')} of data" * bool(findings.logs)
        + f" (not shown: {left})" * bool(left),
        "",
    ]
    known = []
    if first is not None:
        known.append(f"{figure(first.utility)} by the model's policy ({first.candidate.id})")
    if best is not None:
        known.append(f"{figure(best.utility)} best so far ({best.candidate.id})")
    if findings.optimum is not None:
        known.append(f"{figure(findings.optimum)} at the optimum")
    lines.append(f"utility {', '.join(known)}" if known else "no candidate has been run yet")
    lines += ["", "grey: desired; orange: model's policy; blue: best so far; pink: its prediction"]
    if findings.better is not None and best is not None:
        lines[-1] += f"; yellow: limits, and the bias that the model {findings.better.name} leaves"
    if any(crash(run) is not None for run in findings.runs):
        lines[-1] += "; crosses: where and when a run ended early"
    lines += ["", f"**{findings.standing.outcome}**: {_marked(findings.outlook)}", ""]
    lines += [f"**left out**: {one.file}: {one.reason}\n" for one in findings.lost]
    return "\n".join(lines)
