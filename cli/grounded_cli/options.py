"""Options that commands share, opening the workspace of -C, and formatting the next command."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import click

from grounded.errors import NextCommand
from grounded_trials.wording import ELSEWHERE, folded, rendered

if TYPE_CHECKING:
    from grounded_trials import Workspace

F = TypeVar("F", bound=Callable[..., Any])
_KEY = "grounded_cli.folder"


def in_workspace(function: F) -> F:
    """Add the option -C DIR to the group or a command; `given` returns its value."""
    return click.option(
        "-C",
        metavar="DIR",
        expose_value=False,
        callback=_remembered,
        help="The workspace (default: here).",
    )(function)


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


def as_json(function: F) -> F:
    """Add the option --json, passed as `json_`."""
    return click.option("--json", "json_", is_flag=True, help="Print one JSON document.")(function)


def anyway(function: F) -> F:
    """Add the option --anyway, for commands that hand a candidate over."""
    text = "Hand the candidate over even if [limits], [safety], task or model changed since."
    return click.option("--anyway", is_flag=True, help=text)(function)


def parallel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of a command that can run in parallel, passed as `engine`."""

    @functools.wraps(function)
    def call(*args: Any, jobs: int, engine: str, address: str | None, **others: Any) -> Any:
        from grounded.engine import Engine

        return function(*args, engine=Engine(jobs=jobs, name=engine, address=address), **others)

    for option in (
        click.option("--address", metavar="URL", help="Scheduler of a Dask cluster."),
        click.option(
            "--engine",
            type=click.Choice(["local", "dask"]),
            default="local",
            help="Where: on this machine (default) or on a Dask cluster that sees this disk.",
        ),
        click.option(
            "--jobs",
            type=click.IntRange(1),
            metavar="N",
            default=1,
            help="Workers on this machine (default: 1).",
        ),
    ):
        call = option(call)
    return call


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
