"""The page's section on the diagnosis: predictions before and after it, then the details."""

from __future__ import annotations

from grounded.diagnosis.parts import Diagnosis, Estimate
from grounded.diagnosis.pictures import accuracy_figure, credit_figure, where_figure
from grounded.diagnosis.telling import error_table
from grounded_trials.report.figures.gap import forecast_figures, residual_figures
from grounded_trials.report.findings import Findings
from grounded_trials.report.page.tables import (
    Block,
    drawn,
    effect_table,
    forecast_table,
    leftover_table,
    table,
)
from grounded_trials.wording import percent, rendered
from grounded_trials.workspace.last_diagnosis import Since
from grounded_trials.workspace.next_step import DIAGNOSE


def gap_section(findings: Findings) -> list[Block]:
    """What was diagnosed, and forecasts of the crude model beside the better one."""
    diagnosis = findings.diagnosis
    ahead = [b for each in forecast_figures(findings) for b in drawn(each, title=True)]
    lacking = [b for each in residual_figures(findings) for b in drawn(each, title=True)]
    if diagnosis is None:
        command = Block("command", rendered(DIAGNOSE, findings.folder), "c-diagnose")
        return [command, *ahead, *forecast_table(findings), *lacking]
    verdict = Block("verdict", lines=findings.lines)
    if diagnosis.no_cause:  # with too little data, what was fitted is no finding
        return [verdict, *ahead, *forecast_table(findings), *lacking]
    proof = drawn(accuracy_figure(diagnosis), title=True)
    proof += drawn(credit_figure(diagnosis), title=True)
    proof += [*ahead, *forecast_table(findings)]
    return [verdict, *proof, *lacking, *_details(diagnosis, findings.since)]


def _details(diagnosis: Diagnosis, since: Since) -> list[Block]:
    found = drawn(where_figure(diagnosis), title=True)
    rows, header = error_table(diagnosis)
    if rows:
        made = table("diagnosed-errors", header, rows)
        found += [Block("heading", "Errors of held-out predictions"), made]
    if diagnosis.ranking:
        found += [Block("heading", "Effects that were compared"), effect_table(diagnosis, since)]
    if diagnosis.lookalikes:
        alike = [(one.effect, one.like, percent(one.share)) for one in diagnosis.lookalikes]
        found.append(Block("heading", "Look-alikes"))
        found.append(table("lookalikes", ("claimed effect", "look-alike ", "share"), alike))
    return found + _by_trial(diagnosis) + leftover_table(diagnosis)


def _by_trial(diagnosis: Diagnosis) -> list[Block]:
    """Whether every trial asks for the same value, all other values held."""
    found, units = diagnosis.per_trial, dict[tuple[str, str], str]()
    for row in diagnosis.ranking:
        units |= {(row.effect, name): e.unit for name, e in row.params.items()}
    rows = []
    for p in found:
        own = diagnosis.parameters.get(p.quantity)
        unit = own.unit if own else units.get((p.effect, p.quantity), "")
        value = Estimate(p.value, p.std, unit=unit).text
        rows.append((p.effect, p.quantity, p.trial, value, "yes" if p.agrees else "no"))
    header = ("effect", "quantity ", "trial ", "value", "agrees")
    strong = [i for i, p in enumerate(found) if not p.agrees]
    each = table("per-trial", header, rows, strong)
    return [Block("folded", "Trial by trial", blocks=[each], wide=bool(strong))] * bool(found)
