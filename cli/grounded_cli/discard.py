"""grounded discard, restore: leave trials out of everything, or use them again."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from grounded_cli.console import completion as complete
from grounded_cli.console.options import as_json
from grounded_cli.console.terminal import field, names_in, show, show_json
from grounded_cli.console.workspace_option import in_workspace, next_line, open_workspace

if TYPE_CHECKING:
    from grounded_trials.workspace.discarding import SetAside

_trials = click.argument(
    "trials", nargs=-1, required=True, metavar="TRIAL...", shell_complete=complete.trials
)


@click.command("discard")
@_trials
@click.option("--why", default="", metavar="TEXT", help="The reason; `status` shows it.")
@in_workspace
@as_json
def command(trials: tuple[str, ...], why: str, json_: bool) -> None:
    """Set trials aside: search, fit, diagnosis and report leave them out.

    Nothing is deleted: `grounded restore` undoes it. The search goes on as if the trials had not
    been run.
    """
    _tell(open_workspace().discard(*names_in(",".join(trials)), why=why), json_)


@click.command("restore")
@_trials
@in_workspace
@as_json
def restore(trials: tuple[str, ...], json_: bool) -> None:
    """Use discarded trials again."""
    _tell(open_workspace().restore(*names_in(",".join(trials))), json_)


def _tell(done: SetAside, json_: bool) -> None:
    if json_:
        show_json(done.to_json())
        return
    for name in done.trials:
        if name not in done.unchanged:
            show(f"{name} {'discarded' if name in done.discarded else 'counts again'}")
        else:
            show(f"{name}: nothing was changed")
    for name, why in done.discarded.items():
        show(field("discarded", f"{name}{why and ': ' + why}"))
    show(f"\nrun {done.run}, record a log, then" if done.run else "")
    show(next_line(done.then))
