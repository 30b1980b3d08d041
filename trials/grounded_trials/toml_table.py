"""Reads a TOML table key by key and reports every key that nothing asked for.

Every error names the file, the key with its table, what was found, and what was expected.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from grounded.checks import near, refused, wrong
from grounded.errors import GroundedError, NextCommand, alike
from grounded.findings import found
from grounded_trials.plain_file import read_file, unreadable

SIZE_LIMIT = 2**22  # [bytes] of a file
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

    def error(self, key: str, must: str, value: object = None) -> GroundedError:
        """Return an error about one key.

        Args:
            key: of this table.
            must: what its value must be: a word of the entry `given.value`.
            value: what was found, None if the key is missing.
        """
        given = "" if value is None else str(value) if isinstance(value, float) else repr(value)
        return wrong(self._full(key), got=given, must=must, where=self.file.name)

    def _full(self, key: str) -> str:
        return f"[{self.where}] {key}" if self.where else key

    def unknown(self, key: str, valid: Iterable[str], value: str = "") -> GroundedError:
        """Return an error about a key, or the value of a key, that is none of the valid ones."""
        if value:
            facts = near(value, valid)
            return wrong(self._full(key), got=repr(value), where=self.file.name, **facts)
        place = {"where": self.file.name, **near(key, valid)}
        return refused("given.name", self._full(key), kind="key", **place)

    def expect(self, *names: str) -> None:
        """Raise an error for a key that is not among `names`; called before any key is taken."""
        for key in self._values:
            if key not in names:
                raise self.unknown(key, names)

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
                close = alike(key, self._values.keys() - self._known)
                got = repr(close) if close else ""
                raise wrong(self._full(key), got=got, must="given", where=self.file.name)
            return default
        self._taken.add(key)
        return self._checked(key, self._values[key], kind)

    def _checked(self, key: str, value: Any, kind: type) -> Any:
        fits = isinstance(value, kind) and not (isinstance(value, bool) and kind is not bool)
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            if abs(value) > 10**300:
                raise self.error(key, "finite", "over 300 digits")
            return float(value)
        if not fits:
            raise self.error(key, kind.__name__, value)
        if kind is float and not math.isfinite(value):
            raise self.error(key, "finite", value)
        return value

    def choice(self, key: str, options: Iterable[str], default: Any = _REQUIRED) -> str:
        """Return the text of a key, which must be one of the options."""
        value: str = self.take(key, str, default)
        names = list(options)
        if value not in names:
            raise self.unknown(key, names, value)
        return value

    def sub(self, key: str) -> Table:
        """Return the table under a key, empty if it is absent."""
        self._known.add(key)
        self._taken.add(key)
        value = self._values.get(key, {})
        if not isinstance(value, dict):
            raise self.error(key, "dict", value)
        return Table(value, self.file, f"{self.where}.{key}" if self.where else key)

    def numbers(self, key: str, names: Iterable[str]) -> dict[str, float]:
        """Return the table name -> number under a key; its names must be among `names`."""
        table, valid = self.sub(key), list(names)
        values = {name: table.take(name, float) for name in valid if table.has(name)}
        table.finish(valid)
        return values

    def all_numbers(self) -> dict[str, float]:
        """Return this table as name -> number, with any names."""
        return {name: self.take(name, float) for name in self.names()}

    def pairs(self, names: Iterable[str]) -> dict[str, tuple[float, float]]:
        """Return this table as name -> (low, high); its names must be among `names`."""
        valid, pairs = list(names), {}
        for name in valid:
            if self.has(name):
                value = self._values[name]
                self._taken.add(name)
                if not isinstance(value, list) or len(value) != 2:
                    raise self.error(name, "pair", value)
                low, high = (self._checked(name, v, float) for v in value)
                pairs[name] = (low, high)
        self.finish(valid)
        return pairs

    def names(self) -> list[str]:
        """Return all keys."""
        return list(self._values)

    def finish(self, valid: Iterable[str] | None = None) -> None:
        """Raise an error for a key that was not taken; suggests one of the `valid` names."""
        for key in self._values.keys() - self._taken:
            known = self._known if valid is None else valid
            raise self.unknown(key, sorted(known))


def read_toml(path: Path) -> Table:
    """Read a TOML file as a table.

    Raises:
        GroundedError: if it does not exist, can't be read, or is not valid TOML (with line and
            column).
    """
    if not path.exists():
        near = sorted(str(one.parent) for one in path.parent.glob(f"*/{path.name}"))
        then = None if near else NextCommand("init", ("DIR", "--example", "car-turn"))
        here = near[0] if near else ""
        raise GroundedError(found("file.no_workspace", str(path), near=here, then=then))
    try:
        return Table(tomllib.loads(read_file(path, SIZE_LIMIT).decode("utf-8-sig")), path)
    except (ValueError, RecursionError) as error:
        raise unreadable(path, str(error), kind="TOML file") from None


def key(name: str) -> str:
    """Return a name as a key of a TOML file, quoted if it is not a bare key."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name, ensure_ascii=False)
