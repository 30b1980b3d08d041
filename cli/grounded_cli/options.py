"""Options that commands share, and the workspace they name."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import click

from grounded_cli.address import given, remember

if TYPE_CHECKING:
    from grounded.effects import Library
    from grounded_trials.workspace.folder import Workspace

F = TypeVar("F", bound=Callable[..., Any])


def in_workspace(function: F) -> F:
    """Adds -C DIR; the folder is passed as `folder`, falling back on the group's."""
    return click.option(
        "-C",
        "folder",
        default=None,
        metavar="DIR",
        callback=_remembered,
        help="The workspace (default: here).",
    )(function)


def _remembered(ctx: click.Context, option: click.Parameter, folder: str | None) -> str | None:
    remember(ctx, folder)
    return folder


def as_json(function: F) -> F:
    """Adds --json; passed as `json_`."""
    return click.option("--json", "json_", is_flag=True, help="Print one JSON document.")(function)


def open_workspace(folder: str | None) -> Workspace:
    """The workspace that -C names, at the command or before it.

    Raises:
        GroundedError: if its grounded.toml is missing or wrong.
    """
    from grounded_trials.workspace.folder import Workspace

    workspace = Workspace(folder or given() or ".")
    _ = workspace.config
    return workspace


def library_of(without: tuple[str, ...] = ()) -> Library:
    """The effects that may be blamed: built in, and those of other packages.

    A package adds families by the entry point group `grounded.effects`: a family, or a sequence of
    families.

    Raises:
        GroundedError: for an entry point that can't be loaded or holds something else.
    """
    from importlib.metadata import entry_points

    from grounded.effects import Family, Library
    from grounded.errors import GroundedError

    found: list[Family] = []
    for point in entry_points(group="grounded.effects"):
        try:
            loaded = point.load()
        except Exception as error:
            raise GroundedError(
                f"the effects of package '{point.value}' can't be loaded: {error}; mend or "
                "uninstall it"
            ) from None
        families = [loaded] if isinstance(loaded, Family) else list(loaded)
        if not all(isinstance(family, Family) for family in families):
            raise GroundedError(f"'{point.value}' must be an effect family or a sequence of them")
        found += families
    return Library().with_families(found).without(without)
