"""The columns of a table by name, which no two of them may share.

A name that stands twice would say nothing of which column it means, and the last one would be taken
without a word; so would one of two names that are equal without their units.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

from grounded.errors import GroundedError

C = TypeVar("C")


def columns_by_name(columns: Iterable[tuple[str, str, C]], path: Path) -> dict[str, C]:
    """Return columns by their names.

    Args:
        columns: (name, the name as the file writes it, column); without a name it is left out.
        path: the file, for messages.

    Raises:
        GroundedError: if two have the same name.
    """
    found: dict[str, C] = {}
    written: dict[str, str] = {}
    for name, cell, column in columns:
        if name in found:
            both = f"'{written[name]}' and '{cell}'" if cell != written[name] else f"'{cell}'"
            raise GroundedError(
                f"{path}: two columns have the name '{name}' ({both}), so it is unclear which one "
                "is meant: rename or delete one of them"
            )
        if name:
            found[name], written[name] = column, cell
    return found
