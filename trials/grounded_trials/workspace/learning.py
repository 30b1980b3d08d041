"""learn: propose, run and ingest until the search ends; stopped at any moment, it can go on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from grounded.errors import NextCommand
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.ingest import Ingested, ingest_log
from grounded_trials.workspace.proposing import Status, propose_in, standing_in, status_of
from grounded_trials.workspace.running import run_candidate

if TYPE_CHECKING:
    from grounded.search.standing import Candidate


def learn_in(
    workspace: Folder,
    trials: int | None = None,
    *,
    progress: Callable[[str], None] | None = None,
    each: Callable[[Candidate, Ingested], None] | None = None,
) -> Status:
    """The loop over the functions behind `propose`, `run` and `ingest`.

    Args:
        workspace: its [system] runs the candidates.
        trials: at most so many now; None: until the search ends.
        progress: told what is being done.
        each: given every candidate with its trial, once that is stored.

    Raises:
        GroundedError: if a candidate can't be planned or run.
    """
    tell = progress or (lambda stage: None)
    done = 0
    while trials is None or done < trials:
        tell("planning")
        proposed = propose_in(workspace)
        candidate = proposed.candidate
        if candidate is None:
            return status_of(workspace, proposed.standing, proposed.proposal.notes)
        tell(f"running {candidate.id}")
        path = run_candidate(workspace, candidate.id)
        found = ingest_log(workspace, path, candidate.id)
        path.unlink()  # its bytes are in the store now
        done += 1
        if each is not None:
            each(candidate, found)
    status = status_of(workspace, standing_in(workspace))
    goes_on = status.standing.phase == "propose"
    return replace(status, then=NextCommand("learn")) if goes_on else status
