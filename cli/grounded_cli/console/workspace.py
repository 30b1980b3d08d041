"""The option -C: a command's workspace, and the next command to type for it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from grounded.errors import NextCommand
from grounded_trials.wording import ELSEWHERE, folded, rendered

if TYPE_CHECKING:
    from grounded_trials import Workspace

_KEY = "grounded_cli.folder"


def located(ctx: click.Context, option: click.Parameter | None, folder: str | None) -> None:
    """Note the folder of -C, or of a workspace that a command made, for its further commands."""
    if folder is not None:
        ctx.meta[_KEY] = folder


def given() -> str | None:
    """Return the folder of -C of the running command, or None if it was not given."""
    ctx = click.get_current_context(silent=True)
    return None if ctx is None else ctx.meta.get(_KEY)


def open_workspace() -> Workspace:
    """Open the workspace that -C names, at the command or before it.

    Raises:
        GroundedError: if its grounded.toml is missing or invalid.
    """
    from grounded_trials import Workspace  # only commands that have a workspace need it

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
