"""What messages hold, whatever encoded them: a tree of types, and nodes that walk it.

A definition in ROS, IDL or protobuf becomes a `Type`: numbers, texts, structs and arrays of these.
A `Node` is one place of that tree in many messages at once: row i is a value in message `rows[i]`.
`field` goes into a struct, `items` into an array (a message then has as many rows as items, or
none), `keep` drops rows; `numbers` and `equals` read the values. `cdr.py` and `protobuf.py` have
nodes that decode bytes by array operations. JSON's are here: each message tells its own types, so
they are parsed one by one.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from grounded_trials.formats.budget import room, step


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

ROW_LIMIT, ROW_BYTES = 10_000_000, 64  # values that a path may find in a batch; while it does
# [bytes] that parsed JSON takes at most: for each object, each other value, each byte of text
OBJECT, VALUE, LETTER = 250, 90, 2

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]


class BadSchema(Exception):
    """A definition that can't be used; the text says why."""


class BadMessage(Exception):
    """A message's bytes don't fit its schema; `message` is its index in the batch."""

    def __init__(self, message: int, found: str) -> None:
        self.message = int(message)
        super().__init__(found)


class BadPath(Exception):
    """A path does not fit the type of the messages; the text says where and what would fit."""


@dataclass(frozen=True, eq=False)
class Node:
    """One value of `type` in each row; rows are sorted by message."""

    type: Type
    rows: Ints

    def field(self, name: str) -> Node:
        """The struct's field; rows where it is absent drop out."""
        raise NotImplementedError

    def items(self, start: int, stop: int) -> Node:
        """The array's items from start to stop, both included; negative counts from the end."""
        raise NotImplementedError

    def pick(self, index: Ints) -> Self:
        """These rows, in this order; a row may come several times."""
        arrays = ((k, v) for k, v in vars(self).items() if isinstance(v, np.ndarray))
        columns: dict[str, Any] = {name: column[index] for name, column in arrays}
        return replace(self, **columns)

    def keep(self, chosen: Bools) -> Self:
        """The rows where `chosen` is true."""
        return self.pick(np.flatnonzero(chosen))

    def numbered(self, rows: Ints) -> Self:
        """The same values with other numbers for their rows."""
        return replace(self, rows=rows)

    def sample(self) -> Any:
        """The first row's value where only it tells the type (JSON); else None."""
        return None

    def names(self) -> tuple[str, ...]:
        """The fields of a struct."""
        return tuple(self.type.by_name) if isinstance(self.type, Struct) else ()

    def numbers(self) -> Floats:
        """The values of a number, a row each."""
        raise NotImplementedError

    def equals(self, text: str) -> Bools:
        """Where a text is `text`."""
        raise NotImplementedError


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
    if (total := int(lengths.sum())) > ROW_LIMIT:
        raise BadPath(f"it finds {total} values at once; name the items that are meant")
    room(ROW_BYTES * total)
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


def json_messages(buffer: bytes, start: Ints, end: Ints) -> Node:
    """JSON messages at buffer[start[i]:end[i]] as the root of a path.

    null is a number that was not one, since JSON has no NaN; NaN itself is read too, since some
    write it all the same.

    Raises:
        BadMessage: for one that is not JSON.
    """
    objects, taken = [], 0
    for i, (a, b) in enumerate(zip(start.tolist(), end.tolist(), strict=True)):
        text = buffer[a:b]
        taken += OBJECT * text.count(b"{") + VALUE * (text.count(b",") + text.count(b"["))
        taken += LETTER * len(text)
        room(taken)
        try:
            objects.append(json.loads(text))
        except (ValueError, RecursionError) as error:
            raise BadMessage(i, f"it is not JSON: {error}") from None
    return _JsonNode(Dynamic(), np.arange(len(objects)), _as_array(objects))


@dataclass(frozen=True, eq=False)
class _JsonNode(Node):
    """Row i is the parsed value objects[i]; what a message lacks drops out."""

    objects: NDArray[np.object_]

    def sample(self) -> Any:
        """The first message, parsed."""
        return self.objects[0]

    def names(self) -> tuple[str, ...]:
        """Those of the first row that is an object."""
        return next((tuple(o) for o in self.objects if isinstance(o, dict)), ())

    def field(self, name: str) -> _JsonNode:
        step()
        index = [i for i, o in enumerate(self.objects) if isinstance(o, dict) and name in o]
        inner = _as_array([self.objects[i][name] for i in index])
        return replace(self, rows=self.rows[np.array(index, dtype=np.int64)], objects=inner)

    def items(self, start: int, stop: int) -> _JsonNode:
        lists = [o if isinstance(o, list) else [] for o in self.objects]
        row, index = choose_items(np.array(list(map(len, lists)), dtype=np.int64), start, stop)
        pairs = zip(row.tolist(), index.tolist(), strict=True)
        return replace(
            self, rows=self.rows[row], objects=_as_array([lists[i][j] for i, j in pairs])
        )

    def numbers(self) -> Floats:
        values = np.empty(len(self.objects))
        for i, o in enumerate(self.objects):
            if o is None:
                values[i] = np.nan
            elif isinstance(o, int | float):
                values[i] = _as_float(o)
            else:
                what = {"dict": "an object", "list": "a list"}.get(type(o).__name__, "a text")
                raise BadPath(f"it ends at {what} in message {self.rows[i]}, not at a number")
        return values

    def equals(self, text: str) -> Bools:
        return np.array([o == text for o in self.objects], dtype=np.bool_)


def _as_array(objects: list[Any]) -> NDArray[np.object_]:
    return np.fromiter(objects, np.object_, len(objects))


def _as_float(value: float) -> float:
    try:
        return float(value)
    except OverflowError:  # an integer of hundreds of digits
        return np.inf if value > 0 else -np.inf
