"""The columns of a table by name, which no two of them may share.

A name that stands twice would say nothing of which column it means, and the last one would be taken
without a word; so would one of two names that are equal without their units.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

from grounded.errors import GroundedError
from grounded.findings import found

C = TypeVar("C")


def columns_by_name(columns: Iterable[tuple[str, str, C]], path: Path) -> dict[str, C]:
    """Return columns by their names.

    Args:
        columns: (name, the name as the file writes it, column); without a name it is left out.
        path: the file, for messages.

    Raises:
        GroundedError: if two have the same name.
    """
    by_name: dict[str, C] = {}
    written: dict[str, str] = {}
    for name, cell, column in columns:
        if name in by_name:
            raise GroundedError(found("given.twice", str(path), name=name))
        if name:
            by_name[name], written[name] = column, cell
    return by_name
