"""The recording's summary, in Markdown."""

from __future__ import annotations

from grounded_trials.findings import Findings
from grounded_trials.words import count


def summary(findings: Findings) -> str:
    """What was learnt, what is lost, what to do next."""
    task, best, first = findings.task, findings.best, findings.first
    lines = [
        f"# {findings.name}",
        f"{task.model.name}: {task.horizon} steps of {task.dt:g} s, "
        f"{count(len(findings.runs), 'trial')}, {count(len(findings.logs), 'log')} of data",
        "",
        "| | candidate | utility |",
        "|---|---|---|",
    ]
    if first is not None:
        lines.append(f"| the model's policy | {first.candidate.id} | {first.utility:.4g} |")
    if best is not None:
        lines.append(f"| best so far | {best.candidate.id} | {best.utility:.4g} |")
    if findings.optimum is not None:
        lines.append(f"| optimum | | {findings.optimum:.4g} |")
    lines += ["", "grey: desired; orange: model's policy; blue: best so far; pink: its prediction"]
    lines += ["", f"**{findings.standing.phase}**: {findings.standing.sentence}", ""]
    if findings.diagnosis is not None:
        lines += [f"**diagnosis**: {findings.diagnosis.sentence}", ""]
    lines += [f"**left out**: {one.file}: {one.reason}\n" for one in findings.lost]
    lines.append(f"next: `{findings.next_command}`")
    return "\n".join(lines)
