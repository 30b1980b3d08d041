"""GroundedError, the error for wrong user input, and helpers for its messages.

The message says what was found, what was expected and what to do next. Any other exception is a
bug in grounded and keeps its traceback.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, TypeVar

T = TypeVar("T")
COMPARED = 2000  # most names compared with a wrong one


@dataclass(frozen=True)
class NextCommand:
    """A `grounded` command to run next; the command line prints it, with the -C in use.

    Args:
        verb: the command, such as `diagnose`.
        arguments: its arguments, unquoted.
    """

    verb: str
    arguments: tuple[str, ...] = ()


class GroundedError(Exception):
    """Raised for misuse or invalid input; the message is complete and meant for the user.

    Args:
        message: what was found, what was expected, what to do; or a `findings.Finding`, whose
            sentence and command these are.
        then: a command that fixes the problem, if there is one; the message does not repeat it.
    """

    def __init__(self, message: Any, then: NextCommand | None = None) -> None:
        self.finding: Any = None if isinstance(message, str) else message
        super().__init__(message if self.finding is None else message.sentence)
        self.then = then or getattr(self.finding, "then", None)

    def at(self, where: str, unless: str = "") -> GroundedError:
        """Return it with the file or key where it was found, unless its area of codes says that."""
        if self.finding is None:
            return GroundedError(f"{where}: {self}", self.then)
        if self.finding.code.startswith(f"{unless}."):
            return self
        inner = self.finding.facts.get("where", "")
        whole = where if inner in ("", where) else f"{where}: {inner}"
        return GroundedError(self.finding.also(where=whole), self.then)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how to copy it, whatever its class is made from (for another process)."""
        return _copied, (type(self), self.args, vars(self))


def _copied(kind: type[GroundedError], args: tuple[Any, ...], fields: dict[str, Any]) -> Any:
    error = kind.__new__(kind, *args)
    vars(error).update(fields)
    return error


def alike(name: str, valid: Iterable[str]) -> str:
    """Return the valid name closest to `name`, or the only one that ends so; "" if none is."""
    from difflib import get_close_matches

    ends = [known for known in valid if known.rpartition(":")[2] == name]
    if len(ends) == 1:
        return ends[0]
    lower = {known.lower(): known for known in reversed([*valid][:COMPARED])}
    close = get_close_matches(name.lower(), lower, n=1, cutoff=0.6)
    return lower[close[0]] if close else ""


def needs(module: str, extra: str = "") -> Any:
    """Import a library that comes with an optional extra of grounded.

    Args:
        module: the import name, such as "rerun".
        extra: the extra of grounded, such as "view"; "" if it has the name of the package.

    Returns:
        The module.

    Raises:
        GroundedError: if the module can't be imported; the message says how to install it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        extra = extra or module.partition(".")[0]
        raise GroundedError(
            f"this needs the package '{module}' ({error}), which comes with the extra '{extra}': "
            f"pip install '.[{extra}]' in grounded's own folder"
        ) from None
