"""grounded verify: every stored file against its hash and checksums."""

from __future__ import annotations

import click

from grounded_cli.options import as_json, in_workspace, open_workspace
from grounded_cli.terminal import progress, remark, show, show_json


@click.command("verify")
@in_workspace
@as_json
def command(folder: str | None, json_: bool) -> None:
    """Check every stored trial against the hash in its name, and every candidate's checksum."""
    workspace = open_workspace(folder)
    from grounded_trials.workspace.exporting import damaged_files

    with progress("checking"):
        checked, damaged = damaged_files(workspace)
    if json_:
        show_json({"checked": checked, "damaged": [{"file": f, "reason": r} for f, r in damaged]})
    else:
        for _, reason in damaged:
            remark("damaged", reason)
        show(f"{checked} files checked, {len(damaged)} damaged")
    if damaged:
        click.get_current_context().exit(1)
