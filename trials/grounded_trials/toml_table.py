"""Reads a TOML table key by key and reports every key that nothing asked for.

Every error names the file, the key with its table, what was found, and what was expected.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from grounded.errors import GroundedError, NextCommand, nearest
from grounded_trials.plain_file import open_file

SIZE_LIMIT = 2**22  # [bytes] of a file
_WORDS = {
    str: "a text",
    bool: "true or false",
    float: "a number",
    int: "a whole number",
    list: "a list in brackets",
}
_REQUIRED = object()


class Table:
    """One table of a TOML file; `where` is its dotted name, "" for the whole file.

    Taking a key does not remove it: it can be taken again, for example for a second log.
    """

    def __init__(self, values: Mapping[str, Any], file: Path, where: str = "") -> None:
        self._values = dict(values)
        self._known: set[str] = set()
        self._taken: set[str] = set()
        self.file, self.where = file, where

    def error(self, key: str, text: str) -> GroundedError:
        """Return an error about one key."""
        name = f"[{self.where}] {key}" if self.where else key
        return GroundedError(f"{self.file.name}: {name}: {text}")

    def expect(self, *names: str) -> None:
        """Raise an error for a key that is not among `names`; called before any key is taken."""
        for key in self._values:
            if key not in names:
                raise self.error(key, f"is not known here: {nearest(key, names)}")

    def has(self, key: str) -> bool:
        """Return whether the key is present."""
        self._known.add(key)
        return key in self._values

    def peek(self, key: str) -> Any:
        """Return the unchecked value of a key, None if it is absent."""
        return self._values.get(key)

    def take(self, key: str, kind: type, default: Any = _REQUIRED) -> Any:
        """Return the value of a key, checked to be of `kind`; an integer is accepted as a float."""
        self._known.add(key)
        if key not in self._values:
            if default is _REQUIRED:
                raise self.error(key, f"is missing; it must be {_WORDS.get(kind, kind.__name__)}")
            return default
        self._taken.add(key)
        return self._checked(key, self._values[key], kind)

    def _checked(self, key: str, value: Any, kind: type) -> Any:
        fits = isinstance(value, kind) and not (isinstance(value, bool) and kind is not bool)
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            if abs(value) > 10**300:
                raise self.error(key, "must be a finite number, found one of over 300 digits")
            return float(value)
        if not fits:
            raise self.error(key, f"must be {_WORDS.get(kind, kind.__name__)}, found {value!r}")
        if kind is float and not math.isfinite(value):
            raise self.error(key, f"must be a finite number, found {value}")
        return value

    def choice(self, key: str, options: Iterable[str], default: Any = _REQUIRED) -> str:
        """Return the text of a key, which must be one of the options."""
        value: str = self.take(key, str, default)
        names = list(options)
        if value not in names:
            raise self.error(key, f"'{value}' is not one of the choices: {nearest(value, names)}")
        return value

    def sub(self, key: str) -> Table:
        """Return the table under a key, empty if it is absent."""
        self._known.add(key)
        self._taken.add(key)
        value = self._values.get(key, {})
        if not isinstance(value, dict):
            raise self.error(key, f"must be a table, found {value!r}")
        return Table(value, self.file, f"{self.where}.{key}" if self.where else key)

    def numbers(self, key: str, names: Iterable[str]) -> dict[str, float]:
        """Return the table name -> number under a key; its names must be among `names`."""
        table, valid = self.sub(key), list(names)
        found = {name: table.take(name, float) for name in valid if table.has(name)}
        table.finish(valid)
        return found

    def all_numbers(self) -> dict[str, float]:
        """Return this table as name -> number, with any names."""
        return {name: self.take(name, float) for name in self.names()}

    def pairs(self, names: Iterable[str]) -> dict[str, tuple[float, float]]:
        """Return this table as name -> (low, high); its names must be among `names`."""
        valid, found = list(names), {}
        for name in valid:
            if self.has(name):
                value = self._values[name]
                self._taken.add(name)
                if not isinstance(value, list) or len(value) != 2:
                    raise self.error(name, f"must be [low, high], found {value!r}")
                low, high = (self._checked(name, v, float) for v in value)
                found[name] = (low, high)
        self.finish(valid)
        return found

    def names(self) -> list[str]:
        """Return all keys."""
        return list(self._values)

    def finish(self, valid: Iterable[str] | None = None) -> None:
        """Raise an error for a key that was not taken; suggests one of the `valid` names."""
        for key in self._values.keys() - self._taken:
            known = self._known if valid is None else valid
            raise self.error(key, f"is not known here: {nearest(key, sorted(known))}")


def read_toml(path: Path) -> Table:
    """Read a TOML file as a table.

    Raises:
        GroundedError: if it does not exist, can't be read, or is not valid TOML (with line and
            column).
    """
    import tomllib

    try:
        with open_file(path) as stream:
            text = stream.read(SIZE_LIMIT + 1).decode("utf-8-sig")
    except FileNotFoundError:
        near = sorted(str(one.parent) for one in path.parent.glob(f"*/{path.name}"))
        if near:
            raise GroundedError(
                f"{path} does not exist: this is not a workspace; name one, such as {near[0]} (-C "
                f"{near[0]}, in Python Workspace({near[0]!r}))"
            ) from None
        raise GroundedError(
            f"{path} does not exist: this is not a workspace; name its folder (-C DIR, in Python "
            "Workspace(DIR)), or make one",
            NextCommand("init", ("DIR", "--example", "car-turn")),
        ) from None
    except NotADirectoryError:
        raise GroundedError(
            f"{path.parent} is a file: -C takes the folder that holds grounded.toml"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise GroundedError(f"{path} can't be read: {error}") from None
    try:
        if len(text) > SIZE_LIMIT:
            raise ValueError(f"it has more than {SIZE_LIMIT} bytes")
        return Table(tomllib.loads(text), path)
    except (ValueError, RecursionError) as error:
        raise GroundedError(f"{path.name} is not valid TOML: {error}") from None


def key(name: str) -> str:
    """Return a name as a key of a TOML file, quoted if it is not a bare key."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name, ensure_ascii=False)
