"""grounded discard, restore: leave trials out of everything, or use them again."""

from __future__ import annotations

from collections.abc import Iterator

import click

from grounded_cli.console import completion as complete
from grounded_cli.console.options import command
from grounded_cli.console.terminal import field, names_in, show
from grounded_cli.console.workspace_option import next_line, open_workspace
from grounded_trials.workspace.discarding import SetAside

_trials = click.argument(
    "trials", nargs=-1, required=True, metavar="TRIAL...", shell_complete=complete.trials
)


@command("discard")
@_trials
@click.option("--why", default="", metavar="TEXT", help="The reason; `status` shows it.")
def discard(trials: tuple[str, ...], why: str) -> Iterator[SetAside]:
    """Set trials aside: search, fit, diagnosis and report leave them out.

    Nothing is deleted: `grounded restore` undoes it. The search goes on as if the trials had not
    been run.
    """
    done = open_workspace().discard(*names_in(",".join(trials)), why=why)
    yield done
    _tell(done)


@command("restore")
@_trials
def restore(trials: tuple[str, ...]) -> Iterator[SetAside]:
    """Use discarded trials again."""
    done = open_workspace().restore(*names_in(",".join(trials)))
    yield done
    _tell(done)


def _tell(done: SetAside) -> None:
    for name in done.trials:
        if name not in done.unchanged:
            show(f"{name} {'discarded' if name in done.discarded else 'counts again'}")
        else:
            show(f"{name}: nothing was changed")
    for name, why in done.discarded.items():
        show(field("discarded", f"{name}{why and ': ' + why}"))
    show(f"\n{next_line(done.then)}")
