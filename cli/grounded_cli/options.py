"""Options that commands share, and the workspace they name."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from grounded_trials.workspace import Workspace

F = TypeVar("F", bound=Callable[..., Any])


def in_workspace(function: F) -> F:
    """Adds -C DIR; the folder is passed as `folder`, falling back on the group's."""
    return click.option(
        "-C", "folder", default=None, metavar="DIR", help="The workspace (default: here)."
    )(function)


def as_json(function: F) -> F:
    """Adds --json; passed as `json_`."""
    return click.option("--json", "json_", is_flag=True, help="Print one JSON document.")(function)


def open_workspace(folder: str | None) -> Workspace:
    """The workspace that -C names, at the command or before it.

    Raises:
        GroundedError: if its grounded.toml is missing or wrong.
    """
    from grounded_trials.workspace import Workspace

    ctx = click.get_current_context()
    chosen = folder if folder is not None else ctx.find_root().obj or "."
    workspace = Workspace(chosen)
    _ = workspace.config
    return workspace
