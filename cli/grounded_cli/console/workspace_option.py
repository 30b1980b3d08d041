"""The option -C: a command's workspace, and the next command to type for it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from grounded.errors import NextCommand
from grounded_trials.wording import ELSEWHERE, folded, rendered

if TYPE_CHECKING:
    from grounded_trials import Workspace

_KEY = "grounded_cli.folder"


def in_workspace(command: click.Command) -> None:
    """Add the option -C DIR to the group or a command; `given` returns its value."""
    text = "The workspace (default: here)."
    option = click.Option(
        ["-C"], metavar="DIR", expose_value=False, callback=_remembered, help=text
    )
    command.params.append(option)


def _remembered(ctx: click.Context, option: click.Parameter, folder: str | None) -> None:
    if folder is not None:
        ctx.meta[_KEY] = folder


def given(ctx: click.Context | None = None) -> str | None:
    """Return the folder of -C, or None if it was not given.

    Args:
        ctx: the command's context; None: that of the running command.
    """
    ctx = ctx or click.get_current_context(silent=True)
    return None if ctx is None else ctx.meta.get(_KEY)


def located(folder: str) -> None:
    """Print the running command's further commands with the -C of a folder that it made."""
    click.get_current_context().meta[_KEY] = folder


def open_workspace() -> Workspace:
    """Open the workspace that -C names, at the command or before it.

    Raises:
        GroundedError: if its grounded.toml is missing or invalid.
    """
    from grounded_trials import Workspace

    return Workspace(given() or ".")


def typed(then: NextCommand, folder: str | None = None) -> str:
    """Format a command so that it works from the user's current folder.

    Args:
        then: the command.
        folder: the workspace for its -C; None: that of the -C given to this command.
    """
    if folder is None and then.verb not in ELSEWHERE:
        folder = given()
    return rendered(then, folder)


def next_line(then: NextCommand, folder: str | None = None) -> str:
    """Return the last line of an output, `next: ...`, with the command to type next."""
    return folded(typed(then, folder))
