"""grounded export: a candidate for other languages."""

from __future__ import annotations

from pathlib import Path

import click

from grounded_cli import completion as complete
from grounded_cli.options import as_json, in_workspace, open_workspace
from grounded_cli.terminal import show, show_json


@click.command("export")
@click.argument("candidate", metavar="ID", shell_complete=complete.candidates)
@click.option(
    "--format",
    "form",
    type=click.Choice(["csv", "npz", "json"]),
    default="json",
    help="Default: json. npz is what `grounded.policy.load` reads.",
)
@click.option("-o", "--output", metavar="FILE", help="Default: ID.FORMAT in the current folder.")
@in_workspace
@as_json
def command(candidate: str, form: str, output: str | None, folder: str | None, json_: bool) -> None:
    """Write a candidate as csv, npz or json, with units and the time base in the file.

    `best` names the best candidate so far.
    """
    workspace = open_workspace(folder)
    from grounded_trials.exporting import export_candidate

    path = Path(output or f"{candidate}.{form}")
    chosen = export_candidate(workspace, candidate, form, path)
    if json_:
        show_json({"file": str(path), "candidate": chosen, "format": form})
    else:
        show(f"{chosen} is written to {path}")
