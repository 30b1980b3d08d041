"""The learning loop in one call: `learn` for a reachable system, `next` for a robot run by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from grounded.checks import whole_number
from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding
from grounded.findings import found as said
from grounded.result import UNSAID, Document
from grounded.search.candidate import Candidate
from grounded.search.standing import Phase
from grounded_trials.plain_file import path_of
from grounded_trials.workspace.candidates.exporting import Exported, export_in
from grounded_trials.workspace.candidates.proposing import Proposed, Status, propose_in, status_of
from grounded_trials.workspace.candidates.running import run_candidate
from grounded_trials.workspace.candidates.search_state import standing_in
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.gone_wrong import Run
from grounded_trials.workspace.intake.ingest import Ingested, ingest_log
from grounded_trials.workspace.next_step import exported_as

MOST_TRIALS = 100_000


@dataclass(frozen=True, eq=False, repr=False)
class NextRun(Document):
    """The result of `next`: the ingested log, what to run next, and the file for the robot."""

    ALSO = ("trials", "findings")

    taken: Ingested = field(metadata=UNSAID)
    # None if the log should be discarded first
    proposed: Proposed | None = field(metadata={"key": "propose"})
    # None if the search has ended
    exported: Exported | None = field(metadata={"key": "export"})

    def summary(self) -> str:
        """Return what was stored, and what comes next."""
        if self.proposed is None:
            return f"{self.taken.trial} is stored; it should be discarded first"
        name = None if self.proposed.candidate is None else self.proposed.candidate.id
        return f"{self.taken.trial} is stored; next: {name or 'nothing, the search has ended'}"

    @property
    def trials(self) -> tuple[Ingested, ...]:
        """The ingested log, as in the document of `ingest`."""
        return (self.taken,)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is told of the log."""
        return self.taken.findings


def learn_in(
    workspace: Folder,
    trials: int | None = None,
    *,
    progress: Callable[[str], None] | None = None,
    each: Callable[[Candidate, Ingested], None] | None = None,
) -> Status:
    """Propose, run and ingest until the search ends.

    Args:
        workspace: the workspace.
        trials: maximum number of trials in this call; None: until the search ends.
        progress: called with a description of each step.
        each: called with every candidate and its trial, once that is stored.
    """
    if trials is not None:
        whole_number("trials", trials, 0, MOST_TRIALS)
    tell, done, odd = progress or (lambda stage: None), 0, _odd_before(workspace)
    while trials is None or done < trials:
        tell("planning")
        proposed = propose_in(workspace)
        made = proposed.candidate
        if made is None:
            return status_of(workspace, proposed.standing, proposed.findings)
        tell(f"running {made.id}")
        path = run_candidate(workspace, made.id).trial_file
        found = ingest_log(workspace, path, made.id)
        path.unlink()  # its bytes are in the store now
        done += 1
        if each is not None:
            each(made, found)
        if found.faults and not odd:  # the next plan would be based on it: the user decides
            status = status_of(workspace, standing_in(workspace), (said("search.stops"),))
            return replace(status, then=found.then)
    status = status_of(workspace, standing_in(workspace))
    goes_on = status.standing.phase is Phase.PROPOSE
    return replace(status, then=NextCommand("learn")) if goes_on else status


def _odd_before(workspace: Folder) -> bool:
    """Return whether the last run's log had faults too, so that the user has chosen to go on."""
    runs = [trial for trial in workspace.task_trials() if trial.candidate]
    return bool(runs and Run(workspace, runs[-1]).log_faults())


def next_in(
    workspace: Folder, log: str | Path, *, candidate: str | None = None, runner: bool = True
) -> NextRun:
    """Ingest a log, propose the next candidate and export it for the robot, in one call.

    Nothing is proposed from a log that should be discarded. The next candidate is exported as the
    one that the log ran was: in C there is no use for an npz.

    Args:
        workspace: the workspace.
        log: the log of the run.
        candidate: the candidate that was run; None: the outstanding one.
        runner: also write the program that runs the exported candidate.
    """
    try:
        taken = ingest_log(workspace, path_of(log), candidate)
    except GroundedError as error:
        if error.then and error.then.verb == "ingest" and "--data" not in error.then.arguments:
            error.then = NextCommand("next", error.then.arguments)
        raise
    workspace.forget()
    if taken.then.verb == "discard":
        return NextRun(taken, None, None)
    proposed, exported = propose_in(workspace), None
    told = {(one.code, one.about) for one in taken.findings}
    more = tuple(one for one in proposed.findings if (one.code, one.about) not in told)
    proposed = replace(proposed, findings=more)
    if proposed.candidate is not None:
        name, form = proposed.candidate.id, exported_as(workspace, taken.candidate or "")
        runner = runner and form in ("", "npz")
        file = workspace.folder / f"{name}.{form or ('npz' if runner else 'json')}"
        exported = export_in(workspace, name, file, form=form, runner=runner)
    return NextRun(taken, proposed, exported)
