"""Reads a TOML table into dataclasses: each key is checked against the type of its field.

Every error names the file, the key with its table, what was found, and what was expected.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import MISSING, fields
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar, cast, get_args, get_origin, get_type_hints

from grounded.checks import near, refused, wrong
from grounded.errors import GroundedError, NextCommand
from grounded.findings import found
from grounded_trials.plain_file import read_file, unreadable

SIZE_LIMIT = 2**22  # [bytes] of a file
# metadata of a field
MUST_BE = {"positive": {"must": "positive"}, "natural": {"must": "natural"}}
T = TypeVar("T")


class Table:
    """One table of a TOML file; `where` is its dotted name, "" for the whole file."""

    def __init__(self, values: Mapping[str, Any], file: Path, where: str = "") -> None:
        self.values, self.file, self.where = dict(values), file, where

    def error(self, key: str, must: str, value: object = None) -> GroundedError:
        """Return an error about one key: what its value must be, a word of `given.value`."""
        given = "" if value is None else str(value) if isinstance(value, float) else repr(value)
        return wrong(self._full(key), got=given, must=must, where=self.file.name)

    def _full(self, key: str) -> str:
        return f"[{self.where}] {key}" if self.where else key

    def expect(self, names: Iterable[str]) -> None:
        """Raise an error for a key that is not among `names`."""
        valid = list(names)
        for key in self.values:
            if key not in valid:
                place = {"where": self.file.name, **near(key, valid)}
                raise refused("given.name", self._full(key), kind="key", **place)

    def take(self, key: str, kind: Any, default: Any = None) -> Any:
        """Return the value of a key, or the default if it is absent.

        `kind` is a type (an integer is accepted as a float), one with None, a Literal, or a Mapping
        of names to numbers.
        """
        if get_origin(kind) is Mapping:
            return self.sub(key).numbers()
        return self._checked(key, self.values[key], kind) if key in self.values else default

    def _checked(self, key: str, value: Any, kind: Any) -> Any:
        if type(None) in get_args(kind):
            kind = get_args(kind)[0]
        if get_origin(kind) is Literal:
            text, options = self._checked(key, value, str), get_args(kind)
            if text not in options:
                facts = near(text, options)
                raise wrong(self._full(key), got=repr(text), where=self.file.name, **facts)
            return text
        whole = isinstance(value, int) and not isinstance(value, bool)
        if kind is float and whole and abs(value) > 10**300:
            raise self.error(key, "finite", "over 300 digits")
        value = float(value) if kind is float and whole else value
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise self.error(key, kind.__name__, value)
        if kind is float and not math.isfinite(value):
            raise self.error(key, "finite", value)
        return value

    def into(self, kind: type[T], **read: Any) -> T:
        """Return the table as a dataclass; keys that are none of its fields are errors.

        Its fields are of the kinds that `take` knows, but those in `read`, which are given. What
        a number must be is in the metadata of its field, `MUST_BE`.
        """
        known, found = _fields(cast(Any, kind)), dict(read)
        self.expect(known)
        for name, (of, one) in known.items():
            if name not in read and (name in self or one.default is MISSING):
                if name not in self and get_origin(of) is not Mapping:
                    raise self.error(name, "given")
                found[name] = self.take(name, of)
            must, value = one.metadata.get("must"), found.get(name, 1)
            if must and (value < 0 or (value == 0 and must == "positive")):
                raise self.error(name, must, value)
        return kind(**found)

    def sub(self, key: str) -> Table:
        """Return the table under a key, empty if it is absent."""
        value = self.values.get(key, {})
        if not isinstance(value, dict):
            raise self.error(key, "dict", value)
        return Table(value, self.file, f"{self.where}.{key}" if self.where else key)

    def numbers(self, names: Collection[str] | None = None) -> dict[str, float]:
        """Return this table as name -> number; its names must be among `names`, if given."""
        self.expect(self.values if names is None else names)
        return {name: self.take(name, float) for name in names or self.values if name in self}

    def pairs(self, names: Collection[str]) -> dict[str, tuple[float, float]]:
        """Return this table as name -> (low, high); its names must be among `names`."""
        self.expect(names)
        found = {}
        for name in names:
            if name in self:
                value = self.values[name]
                if not isinstance(value, list) or len(value) != 2:
                    raise self.error(name, "pair", value)
                ends = self._checked(name, value[0], float), self._checked(name, value[1], float)
                found[name] = ends
        return found

    def __contains__(self, key: str) -> bool:
        return key in self.values


@cache
def _fields(kind: Any) -> dict[str, tuple[Any, Any]]:
    """Return the type of each field of a dataclass, and the field."""
    hints = get_type_hints(kind)
    return {one.name: (hints[one.name], one) for one in fields(kind)}


def read_toml(path: Path) -> Table:
    """Read a TOML file as a table."""
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
