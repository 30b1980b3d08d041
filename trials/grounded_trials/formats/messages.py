"""Message types, whatever language defined them: numbers, text, structs and arrays of these.

Definitions in ROS, protobuf and JSON schema become this one tree, and `message_path` walks it.

What a message path walks over: the same place in many messages at once.

A node stands for one value of a type in each of its rows; row i belongs to message `rows[i]`.
Walking yields new nodes: `field` goes into a struct, `items` into an array (a message then has as
many rows as items, or none), `keep` drops rows. `numbers` and `texts` read the values. CDR,
ROS 1, protobuf and JSON each implement this and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


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


ROW_LIMIT = 10_000_000  # values that one path may find in one batch of messages

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]


class BadMessage(Exception):
    """A message's bytes don't fit its schema; `message` is its index in the batch."""

    def __init__(self, message: int, found: str) -> None:
        self.message = int(message)
        super().__init__(found)


class BadPath(Exception):
    """A path does not fit the type of the messages; the text says where and what would fit."""


class Node(Protocol):
    """One value of `type` in each row; rows are sorted by message."""

    @property
    def type(self) -> Type:
        """What each row holds."""

    @property
    def rows(self) -> Ints:
        """The message of each row."""

    def field(self, name: str) -> Node:
        """The struct's field; rows where it is absent drop out."""

    def items(self, start: int, stop: int) -> Node:
        """The array's items from start to stop, both included; negative counts from the end."""

    def keep(self, chosen: Bools) -> Node:
        """The rows where `chosen` is true."""

    def numbered(self, rows: Ints) -> Node:
        """The same values with other numbers for their rows."""

    def names(self) -> tuple[str, ...]:
        """The fields of a struct."""

    def numbers(self) -> Floats:
        """The values of a number, a row each."""

    def equals(self, text: str) -> Bools:
        """Where a text is `text`."""


def choose_items(counts: Ints, start: int, stop: int) -> tuple[Ints, Ints]:
    """Which items a slice takes: (row, index) for arrays of counts[row] items.

    Both ends are included and negative ones count from the end, as in Foxglove; what lies outside
    the array is left out.
    """
    first = np.maximum(counts + start, 0) if start < 0 else np.full_like(counts, start)
    last = counts + stop if stop < 0 else np.minimum(counts - 1, stop)
    if start == stop and start < 0:  # one item from the end: none where the array is too short
        first = counts + start
        last = np.where(first < 0, first - 1, first)
    lengths = np.maximum(last - first + 1, 0)
    rows = np.repeat(np.arange(len(counts)), lengths)
    offset = np.arange(len(rows)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    return rows, first[rows] + offset


def texts_equal(buffer: bytes, start: Ints, length: Ints, text: bytes) -> Bools:
    """Where the `length` bytes at `start` are exactly `text`."""
    equal: Bools = length == len(text)
    octets = np.frombuffer(buffer, dtype=np.uint8)
    at = np.flatnonzero(equal)
    for i, octet in enumerate(text):
        at = at[octets[start[at] + i] == octet]
    result = np.zeros(len(start), dtype=np.bool_)
    result[at] = True
    return result
