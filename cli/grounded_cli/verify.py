"""grounded verify: is everything that is kept what it was?"""

from __future__ import annotations

import click

from grounded_cli.options import as_json, in_workspace, open_workspace
from grounded_cli.terminal import progress, remark, show, show_json
from grounded_trials.wording import count


@click.command("verify")
@in_workspace
@as_json
def command(json_: bool) -> None:
    """Check everything that is kept: changed, damaged, deleted, or put in its place."""
    workspace = open_workspace()
    with progress("checking"):
        found = workspace.verify()
    if json_:
        show_json(found.to_json())
    else:
        for one in found.damaged:
            remark("damaged", one.reason)
        show(f"{count(found.checked, 'file')} checked, {len(found.damaged)} damaged")
    if found.damaged:
        click.get_current_context().exit(1)
