"""grounded learn: propose, run and ingest until the search ends."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from grounded_cli.options import as_json, in_workspace, open_workspace
from grounded_cli.status import as_document, next_line, summary
from grounded_cli.terminal import number, progress, remark, say, show, show_json

if TYPE_CHECKING:
    from grounded.search.standing import Standing
    from grounded_trials.workspace.folder import Workspace


@click.command("learn")
@click.option("--trials", type=click.IntRange(min=1), metavar="N", help="At most N trials now.")
@in_workspace
@as_json
def command(trials: int | None, folder: str | None, json_: bool) -> None:
    """Propose, run and ingest until the search ends; stopped at any moment, it can go on."""
    workspace = open_workspace(folder)
    standing = learn_in(workspace, trials)
    if json_:
        show_json(as_document(standing))
        return
    show(summary(standing))
    ended = standing.phase != "propose"
    show(f"\n{next_line(workspace, standing) if ended else 'next: grounded learn'}")


def learn_in(workspace: Workspace, trials: int | None = None) -> Standing:
    """The loop over the commands' own functions; narrates each trial."""
    from grounded_trials.workspace.ingest import ingest_log
    from grounded_trials.workspace.proposing import propose_in, standing_in
    from grounded_trials.workspace.running import run_candidate

    done = 0
    while trials is None or done < trials:
        with progress("planning"):
            proposed = propose_in(workspace)
        candidate = proposed.proposal.candidate
        if candidate is None:
            for note in proposed.proposal.notes:
                remark("note", note)
            return proposed.proposal.standing
        with progress(f"running {candidate.id}"):
            path = run_candidate(workspace, candidate.id)
        found = ingest_log(workspace, Path(path), candidate.id)
        path.unlink()  # its bytes are in the store now
        done += 1
        for warning in found.warnings:
            remark("warning", f"{found.trial}: {warning}")
        say(
            f"{found.trial} {candidate.id} iter {candidate.iteration:<3} "
            f"alpha {candidate.alpha:<8g} predicted {number(candidate.predicted_utility):>10} "
            f"real {number(found.utility):>10}  {found.verdict}"
        )
    return standing_in(workspace)
