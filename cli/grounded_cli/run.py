"""grounded run: the candidate on the real system of grounded.toml."""

from __future__ import annotations

import shlex

import click

from grounded_cli import completion as complete
from grounded_cli.options import as_json, in_workspace, open_workspace
from grounded_cli.terminal import progress, show, show_json


@click.command("run")
@click.argument("candidate", required=False, shell_complete=complete.candidates)
@in_workspace
@as_json
def command(candidate: str | None, folder: str | None, json_: bool) -> None:
    """Run the candidate on [system] and write a trial file for `grounded ingest`.

    CANDIDATE is the outstanding one by default; any candidate, `best` too, may be run again (its
    utilities are averaged).
    """
    workspace = open_workspace(folder)
    from grounded.errors import GroundedError
    from grounded_trials.workspace.proposing import candidate_named, standing_in
    from grounded_trials.workspace.running import run_candidate

    if candidate is None:
        standing = standing_in(workspace)
        if standing.outstanding is None:
            raise GroundedError(
                "no candidate is waiting to be run: `grounded propose` makes the next one, or says "
                "that the search has ended; name a candidate to run it again"
            )
        candidate = standing.outstanding.id
    candidate = candidate_named(workspace, candidate)
    with progress(f"running {candidate}"):
        path = run_candidate(workspace, candidate)
    if json_:
        show_json({"trial_file": str(path), "candidate": candidate})
    else:
        show(f"{candidate} was run: {path}")
        show(f"\nnext: grounded ingest {shlex.quote(str(path))}")
