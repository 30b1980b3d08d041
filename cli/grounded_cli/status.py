"""grounded status, verify: show where the search stands; check the stored files."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import click

from grounded_cli.console.options import as_json, details
from grounded_cli.console.terminal import (
    field,
    number,
    progress,
    remark,
    show,
    show_json,
    sparkline,
    table,
    tell,
)
from grounded_cli.console.workspace_option import in_workspace, next_line, open_workspace
from grounded_trials.wording import count, legend, wrapped

if TYPE_CHECKING:
    from grounded_trials.workspace.candidates.proposing import Status

LEGEND = "damp: penalty on leaving the last trial's inputs; +-: standard error"


@click.command("status")
@details
@in_workspace
@as_json
def command(json_: bool, details: bool) -> None:
    """Show where the search stands, from the stored trials; nothing is written."""
    workspace = open_workspace()
    with progress("reading trials"):
        status = workspace.status()
    if json_:
        show_json(status.to_json())
        return
    show(summary(status))
    tell(status.findings, all_=details)
    for name, why in status.discarded.items():
        show(field("discarded", f"{name}{why and ': ' + why}"))
    if settled := status.settled:
        show(f"\n{table(settled.rows, ('adopted', 'value'))}")
        for one in filter(None, (settled.gained, settled.open)):
            show("\n".join(wrapped(one.sentence, "  ", "  ")))
    show(f"\n{next_line(status.then)}")


@click.command("verify")
@in_workspace
@as_json
def verify(json_: bool) -> None:
    """Find stored files that were changed, damaged, deleted or replaced."""
    workspace = open_workspace()
    with progress("checking"):
        found = workspace.verify()
    if json_:
        show_json(found.to_json())
    else:
        for one in found.damaged:
            remark("damaged", one.reason)
        show(f"{count(found.checked, 'file')} checked, {len(found.damaged)} damaged")
    if found.damaged:
        click.get_current_context().exit(1)


def summary(status: Status) -> str:
    """Return the history as a table, the utilities as bars, and the certainty of the last gain."""
    standing, lines = status.standing, []
    if standing.history:
        lines.append(table(*standing.table()))
        words = legend(LEGEND, [t.candidate.iteration for t in standing.history])
        lines += wrapped(words, "  ", "  ")
        bars = sparkline([t.utility for t in standing.history if t.utilities])
        lines.append("\n" + field("utility", bars) if bars else "")
    if (best := standing.incumbent) is not None:
        text = f"{best.candidate.id}, utility {number(best.utility)}"
        if status.noise:
            text += f", {number(status.noise)} of it by sensor noise"
        lead = standing.lead
        if lead is not None and lead.before.utility and best.candidate.base:
            failed = not math.isfinite(lead.before.utility)
            text += "; the model's own policy failed" if failed else f"; {lead.lead.sentence}"
        lines.append(field("best", text))
    if status.off_target:
        lines.append(field("off target", "; ".join(one.finding.what for one in status.off_target)))
    if status.certainty:
        certain = "; ".join(one.sentence for one in status.certainty)
        lines.append(field("certainty", certain))
    lines.append(field("phase", f"{standing.outcome}: {standing.sentence}"))
    return "\n".join(lines)
