"""The one error that is the user's to mend.

Its text says what was found, what was expected, and what to do next. Anything else that is raised
is a mistake of ours and keeps its traceback.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

MOST, COMPARED = 40, 2000  # names that a message lists, and that are compared with a wrong one


@dataclass(frozen=True)
class NextCommand:
    """A command of `grounded` that helps now, as data: the command line renders it, with its -C.

    Args:
        verb: the command, `diagnose`.
        arguments: its words, unquoted.
    """

    verb: str
    arguments: tuple[str, ...] = ()


class GroundedError(Exception):
    """A misuse or a bad input; the message is complete and meant for a person.

    Args:
        message: what was found, what was expected, what to do.
        then: the command that mends it, where there is one; the message doesn't repeat it.
    """

    def __init__(self, message: str, then: NextCommand | None = None) -> None:
        super().__init__(message)
        self.then = then


def nearest(name: str, valid: Iterable[str]) -> str:
    """Returns ", did you mean 'x'?" for the valid name closest to `name`, or the list of names.

    Args:
        name: what was found.
        valid: the names that would have been right.
    """
    from difflib import get_close_matches

    names = list(valid)
    lower = {known.lower(): known for known in reversed(names[:COMPARED])}
    close = get_close_matches(name.lower(), lower, n=1, cutoff=0.6)
    if close:
        return f"did you mean '{lower[close[0]]}'?"
    if not names:
        return "none is defined"
    more = f" and {len(names) - MOST} more" if len(names) > MOST else ""
    return "valid names: " + ", ".join(names[:MOST]) + more


def needs(module: str, extra: str) -> Any:
    """Imports a library that comes with an extra, so that a plain install stays small.

    Args:
        module: its import name, such as "rerun".
        extra: of grounded, such as "view".

    Returns:
        The module.

    Raises:
        GroundedError: if it can't be imported, with the command that installs it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise GroundedError(
            f"this needs the package '{module}' ({error}), which comes with the extra '{extra}': "
            f"pip install '.[{extra}]' in grounded's own folder"
        ) from None
