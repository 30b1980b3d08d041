"""grounded next: the loop at the track in one command."""

from __future__ import annotations

import click

from grounded.errors import NextCommand
from grounded_cli import completion as complete
from grounded_cli.ingest import tell
from grounded_cli.options import as_json, in_workspace, next_line, open_workspace
from grounded_cli.propose import tell_proposed
from grounded_cli.terminal import field, progress, show, show_json


@click.command("next")
@click.argument("log", metavar="LOG")
@click.option(
    "--candidate", metavar="ID", shell_complete=complete.candidates, help="Which candidate was run."
)
@in_workspace
@as_json
def command(log: str, candidate: str | None, json_: bool) -> None:
    """Ingest what came back, say the verdict, propose, and export for the robot.

    The same as `ingest LOG`, `propose` and `export ID --runner` one after the other; the candidate
    is written into the workspace's folder.
    """
    workspace = open_workspace()
    with progress(f"reading {log} and planning"):
        done = workspace.next(log, candidate=candidate)
    if json_:
        show_json(done.to_json())
        return
    tell(log, done.taken)
    show("")
    tell_proposed(workspace, done.proposed, last=done.exported is None)
    if done.exported is not None:
        show(field("files", f"{done.exported.file}, {done.exported.runner}", "  "))
        then = next_line(NextCommand("next", ("LOG",)))
        ran = done.exported.candidate
        show(f"\ncopy both to the robot, run {ran}, record a log, then\n{then}")
