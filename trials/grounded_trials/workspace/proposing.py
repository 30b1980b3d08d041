"""propose in a workspace: the method's answer, with the candidate's file written."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from grounded.errors import GroundedError
from grounded_trials.workspace.folder import Workspace

if TYPE_CHECKING:
    from collections.abc import Sequence

    from grounded.model import Model
    from grounded.search.improve import Proposal
    from grounded.search.standing import Standing
    from grounded.task import Task
    from grounded.trial import Trial


@dataclass(frozen=True, eq=False)
class Proposed:
    """What `propose` answers, and where the candidate's file is (None: the search has ended)."""

    proposal: Proposal
    file: Path | None


def propose_in(workspace: Workspace) -> Proposed:
    """The next candidate of a workspace; the outstanding one again while its trial is missing."""
    from grounded.search.improve import propose

    proposal = propose(
        workspace.task,
        workspace.search_candidates(),
        workspace.task_trials(),
        workspace.config.search,
        identity=workspace.next_id(),
        planner=workspace.planner,
        refit=refitted,
    )
    candidate = proposal.candidate
    if candidate is None:
        return Proposed(proposal, None)
    path = workspace.candidate_path(candidate.id)
    if proposal.is_new or not path.is_file():
        workspace.save_candidate(candidate, workspace.task)
    if void := _void(proposal):
        proposal = replace(proposal, notes=(*proposal.notes, void))
    return Proposed(proposal, path)


def _void(proposal: Proposal) -> str:
    """That a candidate which was never run is replaced, "" where none is."""
    history, made = proposal.standing.history, proposal.candidate
    last = history[-1] if history else None
    if made is None or not proposal.is_new or last is None or last.trials:
        return ""
    return (
        f"{last.candidate.id} was not run and is void: the model was changed since it was made; "
        f"run {made.id} in its place"
    )


def standing_in(workspace: Workspace, *, ahead: bool = False) -> Standing:
    """Where the search of a workspace stands.

    Args:
        workspace: whose trials and candidates say it.
        ahead: plan the next candidate too, without writing it: only that tells a search that has
            nothing left to gain from one that goes on.
    """
    from grounded.search.improve import model_fingerprint, propose
    from grounded.search.standing import standing

    candidates, trials = workspace.search_candidates(), workspace.task_trials()
    task, options, planner = workspace.task, workspace.config.search, workspace.planner
    now = standing(task, candidates, trials, options, model_fingerprint(planner.plan))
    if ahead and now.phase == "propose" and now.incumbent is not None:
        options_ = {"planner": planner, "refit": refitted}
        return propose(task, candidates, trials, options, **options_).standing  # type: ignore[arg-type]
    return now


def candidate_named(workspace: Workspace, name: str) -> str:
    """The id of a candidate: itself, or that of the best one so far for `best`.

    Raises:
        GroundedError: if there is no best one yet.
    """
    if name != "best":
        return name
    best = standing_in(workspace).incumbent
    if best is None:
        raise GroundedError("there is no best candidate yet: no trial was ingested")
    return best.candidate.id


def refitted(task: Task, trials: Sequence[Trial]) -> Model:
    """The task's model with parameters fitted to all trials ([search] refit)."""
    from grounded.fit import fit

    usable = [t for t in trials if t.finite_steps == t.steps and t.steps > 2]
    return fit(task, usable).model
