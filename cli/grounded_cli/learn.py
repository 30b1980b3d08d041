"""grounded run, learn: run candidates on the [system], once or until the search ends."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from grounded.findings import Finding, Weight
from grounded_cli.console import completion as complete
from grounded_cli.console.options import anyway, as_json
from grounded_cli.console.terminal import (
    number,
    progress,
    remark,
    say,
    show,
    show_json,
    stages,
    tell,
    tinted,
)
from grounded_cli.console.workspace_option import in_workspace, next_line, open_workspace
from grounded_cli.status import summary

if TYPE_CHECKING:
    from grounded.search.candidate import Candidate
    from grounded_trials import Workspace
    from grounded_trials.workspace.candidates.proposing import Status
    from grounded_trials.workspace.intake.ingest import Ingested


@click.command("run")
@click.argument("candidate", required=False, shell_complete=complete.candidates)
@anyway
@in_workspace
@as_json
def run(candidate: str | None, anyway: bool, json_: bool) -> None:
    """Run the candidate on [system] and write a trial file for `grounded ingest`.

    CANDIDATE defaults to the outstanding one. Any candidate may be run again, also `best`; its
    utilities are averaged. It is refused if its file was rewritten, or if [limits], [safety], the
    task or the model changed so that it must not be run any more.
    """
    workspace = open_workspace()

    def warn(one: Finding) -> None:
        tell([one.weighing(Weight.WARN)])

    with progress(f"running {candidate or 'the candidate'}"):
        ran = workspace.run(candidate, anyway=anyway, warn=warn)
    tell(ran.findings, all_=True)
    if json_:
        show_json(ran.to_json())
    else:
        show(f"{ran.candidate} was run: {ran.trial_file}")
        show(f"\n{next_line(ran.then)}")


@click.command("learn")
@click.option("--trials", type=click.IntRange(min=1), metavar="N", help="At most N trials now.")
@in_workspace
@as_json
def command(trials: int | None, json_: bool) -> None:
    """Propose, run and ingest until the search ends; it can be interrupted and resumed."""
    status = narrated(open_workspace(), trials)
    if json_:
        show_json(status.to_json())
        return
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
