"""grounded status, verify: show where the search stands; check the stored files."""

from __future__ import annotations

import math
from collections.abc import Iterator

from grounded_cli.console.options import exits
from grounded_cli.console.terminal import (
    field,
    next_line,
    number,
    open_workspace,
    progress,
    remark,
    show,
    sparkline,
    table,
    tell,
)
from grounded_trials.wording import count, legend, wrapped
from grounded_trials.workspace.candidates.proposing import Status
from grounded_trials.workspace.verifying import Verified

LEGEND = "damp: penalty on leaving the last trial's inputs; +-: standard error"


def status(details: bool) -> Iterator[Status]:
    """Print where the search stands."""
    with progress("reading trials"):
        status = open_workspace().status()
    yield status
    show(summary(status))
    tell(status.findings, all_=details)
    for name, why in status.discarded.items():
        show(field("discarded", f"{name}{why and ': ' + why}"))
    if status.adopted:
        show(f"\n{table(status.adopted, ('adopted', 'value'))}")
    show(f"\n{next_line(status.then)}")


def verify() -> Iterator[Verified]:
    """Check the stored files."""
    with progress("checking"):
        found = open_workspace().verify()
    exits(1 if found.damaged else 0)
    yield found
    for one in found.damaged:
        remark("damaged", one.reason)
    show(f"{count(found.checked, 'file')} checked, {len(found.damaged)} damaged")


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
