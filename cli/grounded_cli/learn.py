"""grounded run, learn: run candidates on the [system], once or until the search ends."""

from __future__ import annotations

from collections.abc import Iterator

from grounded.findings import Finding, Weight
from grounded.search.candidate import Candidate
from grounded_cli.console.terminal import (
    next_line,
    number,
    open_workspace,
    progress,
    remark,
    say,
    show,
    stages,
    tell,
    tinted,
)
from grounded_cli.status import summary
from grounded_trials import Workspace
from grounded_trials.workspace.candidates.proposing import Status
from grounded_trials.workspace.candidates.running import Ran
from grounded_trials.workspace.intake.ingest import Ingested


def run(candidate: str | None, anyway: bool) -> Iterator[Ran]:
    """Run the candidate on [system]."""

    def warn(one: Finding) -> None:
        tell([one.weighing(Weight.WARN)])

    with progress(f"running {candidate or 'the candidate'}"):
        ran = open_workspace().run(candidate, anyway=anyway, warn=warn)
    tell(ran.findings, all_=True)
    yield ran
    show(f"{ran.candidate} was run: {ran.trial_file}")
    show(f"\n{next_line(ran.then)}")


def learn(trials: int | None) -> Iterator[Status]:
    """Learn until the search ends."""
    status = narrated(open_workspace(), trials)
    yield status
    show(summary(status))
    show(f"\n{next_line(status.then)}")


def narrated(workspace: Workspace, trials: int | None = None) -> Status:
    """Run the learning loop and print a line for each trial."""
    with stages() as stage:

        def each(candidate: Candidate, found: Ingested) -> None:
            stage("")
            for warning in found.warnings:
                remark("warning", f"{found.trial}: {warning}")
            say(
                f"{found.trial}  {candidate.id}  predicted "
                f"{number(candidate.predicted_utility):>9}  real {number(found.utility):>9}  "
                f"{tinted(found.verdict)}"
            )

        status = workspace.learn(trials, progress=stage, each=each)
    tell(status.findings, all_=True)
    return status
