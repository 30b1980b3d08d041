"""grounded learn: propose, run and ingest until the search ends."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from grounded_cli.options import as_json, in_workspace, next_line, open_workspace
from grounded_cli.status import summary
from grounded_cli.terminal import number, remark, say, show, show_json, stages, tinted

if TYPE_CHECKING:
    from grounded.search.candidate import Candidate
    from grounded_trials import Workspace
    from grounded_trials.workspace.ingest import Ingested
    from grounded_trials.workspace.proposing import Status


@click.command("learn")
@click.option("--trials", type=click.IntRange(min=1), metavar="N", help="At most N trials now.")
@in_workspace
@as_json
def command(trials: int | None, json_: bool) -> None:
    """Propose, run and ingest until the search ends; stopped at any moment, it can go on."""
    status = narrated(open_workspace(), trials)
    if json_:
        show_json(status.to_json())
        return
    show(summary(status))
    show(f"\n{next_line(status.then)}")


def narrated(workspace: Workspace, trials: int | None = None) -> Status:
    """Learns, with a line for each trial."""
    with stages() as tell:

        def each(candidate: Candidate, found: Ingested) -> None:
            tell("")
            for warning in found.warnings:
                remark("warning", f"{found.trial}: {warning}")
            say(
                f"{found.trial}  {candidate.id}  predicted "
                f"{number(candidate.predicted_utility):>9}  real {number(found.utility):>9}  "
                f"{tinted(found.verdict)}"
            )

        status = workspace.learn(trials, progress=tell, each=each)
    for note in status.notes:
        remark("note", note)
    return status
