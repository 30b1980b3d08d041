"""Reads and writes small YAML files: plain tables, lists, texts and numbers, nothing executable."""

from __future__ import annotations

from collections.abc import Mapping
from io import StringIO
from pathlib import Path
from typing import Any

from grounded.checks import wrong
from grounded_trials.plain_file import open_file, unreadable

LARGEST = 2**20  # [bytes] of a file


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the table that a YAML file holds.

    Raises:
        GroundedError: if it can't be read, or holds something else.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        with open_file(path) as stream:
            text = stream.read(LARGEST).decode("utf-8")
        table = YAML(typ="safe", pure=True).load(text)
    except (OSError, UnicodeDecodeError, YAMLError, RecursionError, ValueError) as error:
        raise unreadable(path, str(error), kind="YAML file") from None
    if not isinstance(table, dict):
        raise wrong(path.name, must="dict")
    return {str(key): value for key, value in table.items()}


def as_yaml(table: Mapping[str, Any]) -> bytes:
    """Return a table as YAML, innermost tables on one line."""
    from ruamel.yaml import YAML

    yaml: Any = YAML(typ="safe", pure=True)
    stream = StringIO()
    yaml.default_flow_style, yaml.width, yaml.sort_base_mapping_type_on_output = None, 1000, False
    yaml.dump(dict(table), stream)
    return stream.getvalue().encode()


def number_in(path: Path, key: str, value: Any) -> tuple[float, float]:
    """Return a value and its standard deviation (NaN if not given): a number, or a table of both.

    Raises:
        GroundedError: if it is something else.
    """
    table = value if isinstance(value, Mapping) else {"value": value}
    numbers: list[Any] = [table.get("value"), table.get("std", float("nan"))]
    if not all(isinstance(n, int | float) and not isinstance(n, bool) for n in numbers):
        raise wrong(key, value, must="number", where=path.name)
    return float(numbers[0]), float(numbers[1])
