"""The texts of a recording, in Markdown: what to run next, the diagnosis, and a summary."""

from __future__ import annotations

import re

from grounded.figures.figure import typeset
from grounded_trials.report.figures.paths import crash
from grounded_trials.report.findings import Findings
from grounded_trials.wording import count, figure


def verdict(findings: Findings) -> str:
    """Return the next command, and the diagnosis in a few lines (Markdown)."""
    lines = [f"next: `{findings.next_command}`\n"]
    if findings.diagnosis is None:
        lines.append("not diagnosed yet\n")
    lines += [f"{_marked(line)}\n" for line in findings.lines]
    return "\n".join(lines)


def credit(findings: Findings) -> str:
    """Return the causes as a table (Markdown); "" if there is none."""
    said = findings.told
    if said is None or not said.rows:
        return ""
    rows = (said.header, ("---",) * len(said.header), *said.rows)
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


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
