"""Commands that are printed work from where the user is: with -C DIR, they are printed with it.

Every word that a command prints passes `addressed`, so nobody else needs to think of it.
"""

from __future__ import annotations

import re
import shlex

import click

from grounded_trials.wording import WIDTH, folded, wrapped

# the commands that take -C
COMMANDS = (
    "propose",
    "run",
    "ingest",
    "learn",
    "status",
    "report",
    "view",
    "fit",
    "diagnose",
    "adopt",
    "inspect",
    "export",
    "verify",
)
_KEY = "grounded_cli.folder"
_NEXT = "next: "
_BROKEN = " \\\n    "  # as `folded` breaks a command
# not after a `cd DIR &&` of its own; a line may be broken between the two words
_CALL = re.compile(rf"(?<![\w/.&-])(?<!&& )grounded(?=\s+(?:{'|'.join(COMMANDS)})\b)")


def remember(ctx: click.Context, folder: str | None) -> None:
    """Keeps what -C named, at the command or before it."""
    if folder is not None:
        ctx.meta[_KEY] = folder


def given() -> str | None:
    """The folder as -C named it, None where it was not given."""
    ctx = click.get_current_context(silent=True)
    return None if ctx is None else ctx.meta.get(_KEY)


def addressed(text: str, *, fit: bool = True) -> str:
    """A text whose commands name the workspace as the user did.

    Args:
        text: what is to be printed.
        fit: break lines that grow wider than a terminal.
    """
    folder = given()
    if folder is None or "grounded" not in text:
        return text
    call = f"grounded -C {shlex.quote(folder)}"
    whole, lines = text.replace(_BROKEN, " "), []
    after = _CALL.sub(lambda _: call, whole).split("\n")
    for line, found in zip(whole.split("\n"), after, strict=True):
        wide = fit and found != line and len(found) > WIDTH and not found.startswith("#")
        lines += _fitted(found) if wide else [found]
    return "\n".join(lines)


def _fitted(line: str) -> list[str]:
    """A line that grew wider than a terminal, broken; a command as a shell allows."""
    if line.startswith(_NEXT):
        return folded(line.removeprefix(_NEXT)).split("\n")
    indent = line[: len(line) - len(line.lstrip())]
    return wrapped(line[len(indent) :], indent, indent) or [line]
