"""grounded status, verify: show where the search stands; check the stored files."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import click

from grounded_cli.console.options import as_json
from grounded_cli.console.terminal import (
    field,
    number,
    progress,
    remark,
    show,
    show_json,
    sparkline,
    table,
)
from grounded_cli.console.workspace_option import in_workspace, next_line, open_workspace
from grounded_cli.propose import noise_share
from grounded_trials.wording import count, legend, rendered, wrapped

if TYPE_CHECKING:
    from grounded.search.standing import Standing
    from grounded_trials.workspace.candidates.proposing import Status

LEGEND = "damp: penalty on leaving the last trial's inputs; +-: standard error"


@click.command("status")
@in_workspace
@as_json
def command(json_: bool) -> None:
    """Show where the search stands, from the stored trials; nothing is written."""
    workspace = open_workspace()
    with progress("reading trials"):
        status = workspace.status()
    if json_:
        show_json(status.to_json())
        return
    show(summary(status))
    settled, model = None, workspace.config.model
    if model.effects or model.params:  # else nothing was adopted, and slow imports are saved
        from grounded_trials.report.settled import settled_in
        from grounded_trials.workspace.last_diagnosis import Since

        settled = settled_in(workspace, status.diagnosis, status.since or Since())
    for note in status.notes:
        remark("note", note)
    for name, why in status.discarded.items():
        show(field("discarded", f"{name}{why and ': ' + why}"))
    if settled:
        show(f"\n{table(settled.rows, ('adopted', 'value'))}")
        for one in filter(None, (settled.gained, settled.open)):
            show("\n".join(wrapped(one.sentence, "  ", "  ")))
    if status.outdated:
        show("\n" * bool(settled) + field("diagnosis", status.outdated))
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
    from grounded.search.certainty import beyond_one_trial, last_improvement
    from grounded_trials.workspace.next_step import outlook

    standing, lines = status.standing, []
    if standing.history:
        lines.append(table(*standing.table()))
        words = legend(LEGEND, [t.candidate.iteration for t in standing.history])
        lines += wrapped(words, "  ", "  ")
        bars = sparkline([t.utility for t in standing.history if t.utilities])
        lines.append("\n" + field("utility", bars) if bars else "")
    if standing.incumbent is not None:
        best = standing.incumbent
        text = f"{best.candidate.id}, utility {number(best.utility)}{noise_share(best)}"
        lines.append(field("best", text + _gained(standing)))
        if less := standing.less_in_log:
            lines.append(field("predicted", less))
    if status.off_target:
        lines.append(field("off target", "; ".join(one.summary() for one in status.off_target)))
    exported = "then " * (status.again.verb == "next")
    again = f" ({exported}`{rendered(status.again)}`)"
    if certainty := last_improvement(standing.history, again):
        ran = {t.candidate.id for t in standing.history if t.trials}
        waiting = standing.outstanding
        if waiting and waiting.id not in ran and standing.incumbent is not None:
            small = beyond_one_trial(waiting, standing.incumbent, standing.missing)
            certainty = "; ".join(filter(None, (certainty, small)))
        lines.append(field("certainty", certainty))
    lines.append(field("phase", f"{standing.outcome}: {outlook(standing, status.then)}"))
    return "\n".join(lines)


def _gained(standing: Standing) -> str:
    """Return by how much the best candidate beats the model's own policy, as a sentence's end."""
    from grounded.search.certainty import by_starts, share_of_cost

    best, own = standing.incumbent, standing.history[0]
    if best is None or best.candidate is own.candidate or own.candidate.base or not own.utilities:
        return ""
    if not math.isfinite(own.utility):
        return "; the model's own policy failed"
    if best.candidate.base == "" or not own.utility:
        return ""
    if why := standing.lead_doubt:
        return f"; {why}"
    share = share_of_cost(own, best, standing.history)
    gain = f", {share} better than the model's own policy"
    start = by_starts(own, best, standing.history)
    return f"{gain}; {start}" if start else gain
