"""propose and status in a workspace: the search's answers, with the candidate's file written."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grounded.errors import GroundedError, NextCommand
from grounded.result import Result
from grounded_trials.workspace.folder import Contents, Folder

if TYPE_CHECKING:
    from collections.abc import Sequence

    from grounded.model import Model
    from grounded.search.improve import Proposal
    from grounded.search.standing import Candidate, Standing
    from grounded.task import Task
    from grounded.trial import Trial


@dataclass(frozen=True, eq=False, repr=False)
class Proposed(Result):
    """What `propose` answers."""

    proposal: Proposal
    file: Path | None  # the candidate's; None: the search has ended
    then: NextCommand

    @property
    def candidate(self) -> Candidate | None:
        """What to run next."""
        return self.proposal.candidate

    @property
    def standing(self) -> Standing:
        """Where the search stands."""
        return self.proposal.standing

    def summary(self) -> str:
        """The candidate, or the end of the search."""
        return self.proposal.summary()

    def to_json(self) -> dict[str, Any]:
        """The document of `propose --json`; candidate is null when the search has ended."""
        return self.proposal.to_json() | {"file": str(self.file) if self.file else None}


@dataclass(frozen=True, eq=False, repr=False)
class Status(Result):
    """What `status` answers: where the search stands, and what to do next."""

    standing: Standing
    then: NextCommand
    outdated: str = ""  # why the last diagnosis is not the last word
    notes: tuple[str, ...] = ()  # of the search, where it has ended

    def summary(self) -> str:
        """The phase and the best candidate."""
        return self.standing.summary()

    def to_json(self) -> dict[str, Any]:
        """The document of `status --json`, the whole history in it."""
        return self.standing.to_json()


def propose_in(workspace: Folder) -> Proposed:
    """The next candidate of a workspace; the outstanding one again while its trial is missing."""
    from grounded.search.improve import propose

    proposal = propose(
        workspace.task,
        workspace.read().candidates,
        workspace.task_trials(),
        workspace.config.search,
        identity=workspace.next_id(),
        planner=workspace.planner,
        refit=refitted,
    )
    candidate = proposal.candidate
    if candidate is None:
        return Proposed(proposal, None, status_of(workspace, proposal.standing).then)
    path = workspace.candidate_path(candidate.id)
    if proposal.is_new or not path.is_file():
        workspace.save_candidate(candidate, workspace.task)
    if void := _void(proposal):
        proposal = replace(proposal, notes=(*proposal.notes, void))
    here = workspace.config.system.reachable
    then = NextCommand("run") if here else NextCommand("ingest", ("TRIAL.mcap",))
    return Proposed(proposal, path, then)


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


def standing_in(
    workspace: Folder, *, ahead: bool = False, contents: Contents | None = None
) -> Standing:
    """Where the search of a workspace stands.

    Args:
        workspace: whose trials and candidates say it.
        ahead: plan the next candidate too, without writing it: only that tells a search that has
            nothing left to gain from one that goes on.
        contents: what the folder holds, where it was read already.

    Raises:
        GroundedError: if a stored file is damaged, or the task can't be planned.
    """
    from grounded.search.improve import model_fingerprint, propose
    from grounded.search.standing import standing

    contents = contents or workspace.read()
    trials = [t.trial for t in contents.trials if workspace.fits(t.trial)]
    task, options, planner = workspace.task, workspace.config.search, workspace.planner
    now = standing(task, contents.candidates, trials, options, model_fingerprint(planner.plan))
    if ahead and now.phase == "propose" and now.incumbent is not None:
        return propose(
            task, contents.candidates, trials, options, planner=planner, refit=refitted
        ).standing
    return now


def status_of(workspace: Folder, standing: Standing, notes: tuple[str, ...] = ()) -> Status:
    """A standing with the command to type next, and what became of the last diagnosis.

    Raises:
        GroundedError: if a stored file is damaged.
    """
    from grounded_trials.workspace.diagnosing import read_diagnosis
    from grounded_trials.workspace.next_step import next_command, since_diagnosis, usable_ids

    usable = usable_ids(workspace)
    try:
        found = read_diagnosis(workspace.reports)
    except GroundedError:  # a damaged one is made again
        found = None
    since = since_diagnosis(workspace, found, usable) if found else None
    return Status(
        standing,
        next_command(workspace, standing, found, usable),
        since.told(workspace.address) if since else "",
        notes,
    )


def candidate_named(workspace: Folder, name: str) -> str:
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
