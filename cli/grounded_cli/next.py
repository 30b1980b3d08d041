"""grounded next: store a log of the real system, and go on from it."""

from __future__ import annotations

from collections.abc import Iterator

from grounded.errors import NextCommand
from grounded.findings import found
from grounded_cli.console.terminal import field, next_line, open_workspace, progress, show, tell
from grounded_cli.ingest import tell_ingested
from grounded_cli.propose import tell_proposed
from grounded_trials.workspace.looping import NextRun


def following(log: str, candidate: str | None, details: bool) -> Iterator[NextRun]:
    """Ingest a log, propose, and export for the robot."""
    workspace = open_workspace()
    with progress(f"reading {log} and planning"):
        done = workspace.next(log, candidate=candidate)
    yield done
    tell_ingested(log, done.taken, details)
    if done.proposed is None:
        trial, ran = done.taken.trial, done.taken.candidate
        tell([found("search.discard_first", trial=trial, candidate=ran)], all_=True)
        return show(next_line(done.taken.then))
    show("")
    tell_proposed(done.proposed)
    if done.exported is None:
        return show(f"\n{next_line(done.proposed.then)}")
    files = filter(None, (done.exported.file, done.exported.runner))
    show(field("files", ", ".join(map(str, files)), "  "))
    tell([found("search.to_robot", done.exported.candidate)], all_=True)
    show(next_line(NextCommand("next", ("LOG",))))
