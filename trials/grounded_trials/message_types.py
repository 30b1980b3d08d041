"""Message types, whatever language defined them: numbers, text, structs and arrays of these.

Definitions in ROS, protobuf and JSON schema become this one tree, and `message_path` walks it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property


@dataclass(frozen=True)
class Number:
    """A number of a numpy kind without byte order: f8, f4, i1 .. i8, u1 .. u8, b1.

    `coding` is protobuf's of integers: "varint", "zigzag" (sint32, ...) or "fixed" (fixed32, ...).
    """

    kind: str
    coding: str = "varint"

    @property
    def size(self) -> int:
        """Size on the wire [bytes]."""
        return int(self.kind[1:])

    def __str__(self) -> str:
        word = {"f": "float", "i": "int", "u": "uint", "b": "bool"}[self.kind[0]]
        return word if word == "bool" else f"{word}{8 * self.size}"


@dataclass(frozen=True)
class Text:
    """A string; `unit` is the size of a character on the wire (0: a size nobody agrees on)."""

    unit: int = 1

    def __str__(self) -> str:
        return "string" if self.unit == 1 else "wstring"


@dataclass(frozen=True)
class Array:
    """Items of one type: `count` of them, or as many as the message says (None)."""

    item: Type
    count: int | None = None

    def __str__(self) -> str:
        return f"{self.item}[{'' if self.count is None else self.count}]"


@dataclass(frozen=True, eq=False)
class Field:
    """A named member of a struct; `number` is protobuf's, `default` its value when absent."""

    name: str
    type: Type
    number: int = 0
    default: float = 0.0


@dataclass(frozen=True, eq=False)
class Struct:
    """Named fields in wire order. Recursive types (protobuf) refer to the same object."""

    name: str
    fields: tuple[Field, ...]

    @cached_property
    def by_name(self) -> dict[str, Field]:
        """Field by name."""
        return {f.name: f for f in self.fields}

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True)
class Dynamic:
    """A value whose type only the message tells (JSON)."""

    def __str__(self) -> str:
        return "value"


Type = Number | Text | Array | Struct | Dynamic
