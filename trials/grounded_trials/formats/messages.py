"""The contents of messages, whatever their encoding: a tree of types, and nodes that walk it.

A definition in ROS, IDL or protobuf becomes a `Type`: numbers, texts, structs and arrays of these.
A `Node` is one place of that tree in many messages at once: row i is a value in message `rows[i]`.
`field` goes into a struct, `items` into an array (a message then has as many rows as items, or
none), `keep` drops rows; `numbers` and `equals` read the values. The nodes in `cdr.py` decode bytes
by array operations; those for JSON, here, and in `protobuf.py` hold messages parsed one by one.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from grounded_trials.formats.bad import BadMessage, BadPath


@dataclass(frozen=True)
class Number:
    """A number of a NumPy kind without byte order: f8, f4, i1 .. i8, u1 .. u8, b1."""

    kind: str

    @property
    def size(self) -> int:
        """Size on the wire [bytes]."""
        return int(self.kind[1:])

    def __str__(self) -> str:
        word = {"f": "float", "i": "int", "u": "uint", "b": "bool"}[self.kind[0]]
        return word if word == "bool" else f"{word}{8 * self.size}"


@dataclass(frozen=True)
class Text:
    """A string; `unit` is the size of a character on the wire (0: not standardised)."""

    unit: int = 1

    def __str__(self) -> str:
        return "string" if self.unit == 1 else "wstring"


@dataclass(frozen=True)
class Array:
    """Items of one type: a fixed `count`, or as many as the message states (None)."""

    item: Type
    count: int | None = None

    def __str__(self) -> str:
        return f"{self.item}[{'' if self.count is None else self.count}]"


@dataclass(frozen=True, eq=False)
class Field:
    """A named member of a struct; `number` is that of protobuf."""

    name: str
    type: Type
    number: int = 0


@dataclass(frozen=True, eq=False)
class Struct:
    """Named fields in wire order. Recursive types (protobuf) refer to the same object."""

    name: str
    fields: tuple[Field, ...]
    definition: bytes | None = None  # of protobuf, serialised

    @cached_property
    def by_name(self) -> dict[str, Field]:
        """Field by name."""
        return {f.name: f for f in self.fields}

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True)
class Dynamic:
    """A value whose type is known only from the message (JSON)."""

    def __str__(self) -> str:
        return "value"


Type = Number | Text | Array | Struct | Dynamic

DEPTH_LIMIT, COUNT_LIMIT = 64, 10**8  # nesting of types; items of an array
_KINDS = {"int": ("i", 1, 2, 4, 8), "uint": ("u", 1, 2, 4, 8), "float": ("f", 4, 8)}
NUMBERS = {  # by their ROS names: int8 ... float64
    f"{word}{8 * size}": Number(f"{kind}{size}")
    for word, (kind, *sizes) in _KINDS.items()
    for size in sizes
} | {"bool": Number("b1"), "char": Number("u1")}

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Node:
    """One value of `type` in each row; rows are sorted by message."""

    type: Type
    rows: Ints

    def field(self, name: str) -> Node:
        """Return the node of a struct's field, without the rows where it is absent."""
        raise NotImplementedError

    def items(self, start: int, stop: int) -> Node:
        """Return array items from start to stop, both included; negative counts from the end."""
        raise NotImplementedError

    def pick(self, index: Ints) -> Self:
        """Return these rows, in this order; a row may occur several times."""
        arrays = ((k, v) for k, v in vars(self).items() if isinstance(v, np.ndarray))
        columns: dict[str, Any] = {name: column[index] for name, column in arrays}
        return replace(self, **columns)

    def keep(self, chosen: Bools) -> Self:
        """Return the rows where `chosen` is true."""
        return self.pick(np.flatnonzero(chosen))

    def numbered(self, rows: Ints) -> Self:
        """Return the same values with other row numbers."""
        return replace(self, rows=rows)

    def sample(self) -> Any:
        """Return the first row's parsed value if the type is dynamic (JSON), else None."""
        return None

    def names(self) -> tuple[str, ...]:
        """Return the field names of a struct."""
        return tuple(self.type.by_name) if isinstance(self.type, Struct) else ()

    def numbers(self) -> Floats:
        """Return the values of a number, one per row."""
        raise NotImplementedError

    def equals(self, text: str) -> Bools:
        """Return where a text equals `text`."""
        raise NotImplementedError

    def texts(self) -> list[str]:
        """Return the texts, one per row."""
        raise NotImplementedError


def choose_items(counts: Ints, start: int, stop: int) -> tuple[Ints, Ints]:
    """Return the items that a slice selects, as (row, index), for arrays of counts[row] items.

    Both ends are included and negative ones count from the end, as in Foxglove; indices outside
    the array are left out.
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
    """Return where the `length` bytes at `start` are exactly `text`."""
    equal: Bools = length == len(text)
    octets = np.frombuffer(buffer, dtype=np.uint8)
    at = np.flatnonzero(equal)
    for i, octet in enumerate(text):
        at = at[octets[start[at] + i] == octet]
    result = np.zeros(len(start), dtype=np.bool_)
    result[at] = True
    return result


def json_messages(buffer: bytes, start: Ints, end: Ints) -> Node:
    """Return the root node of JSON messages at buffer[start[i]:end[i]].

    null is read as NaN, which JSON does not have; NaN itself is accepted too, since some programs
    write it.

    Raises:
        BadMessage: for a message that is not JSON.
    """
    objects = []
    for i, (a, b) in enumerate(zip(start.tolist(), end.tolist(), strict=True)):
        try:
            objects.append(json.loads(buffer[a:b]))
        except (ValueError, RecursionError) as error:
            raise BadMessage(i, "decode", what="JSON", why=str(error)) from None
    return _JsonNode(Dynamic(), np.arange(len(objects)), as_array(objects))


@dataclass(frozen=True, eq=False)
class ObjectNode(Node):
    """Row i is the parsed value objects[i]; an object without a field has no row there."""

    objects: NDArray[np.object_]

    def among(self, kind: Type, rows: Ints, objects: list[Any]) -> Self:
        """Return the node of values inside those of this one."""
        return replace(self, type=kind, rows=rows, objects=as_array(objects))

    def items(self, start: int, stop: int) -> Self:
        """Return items of lists; whatever else there is has none."""
        none = (str, dict, int, float, type(None))
        counts = [0 if isinstance(o, none) else len(o) for o in self.objects]
        row, index = choose_items(np.array(counts, dtype=np.int64), start, stop)
        pairs = zip(row.tolist(), index.tolist(), strict=True)
        kind = self.type.item if isinstance(self.type, Array) else self.type
        return self.among(kind, self.rows[row], [self.objects[i][j] for i, j in pairs])

    def equals(self, text: str) -> Bools:
        """Return where a text, or its bytes, equals `text`."""
        return np.array([o in (text, text.encode()) for o in self.objects], dtype=np.bool_)

    def texts(self) -> list[str]:
        """Return the objects as texts."""
        return list(map(str, self.objects))


@dataclass(frozen=True, eq=False)
class _JsonNode(ObjectNode):
    def sample(self) -> Any:
        """Return the first message, parsed."""
        return self.objects[0]

    def names(self) -> tuple[str, ...]:
        """Return the names in the first row that is an object."""
        return next((tuple(o) for o in self.objects if isinstance(o, dict)), ())

    def field(self, name: str) -> _JsonNode:
        index = [i for i, o in enumerate(self.objects) if isinstance(o, dict) and name in o]
        rows = self.rows[np.array(index, dtype=np.int64)]
        return self.among(self.type, rows, [self.objects[i][name] for i in index])

    def numbers(self) -> Floats:
        values = np.empty(len(self.objects))
        for i, o in enumerate(self.objects):
            if o is not None and not isinstance(o, int | float):
                at = f"message {self.rows[i]}"
                raise BadPath("path", expected="number", found=type(o).__name__, at=at)
            values[i] = np.nan if o is None else _as_float(o)
        return values


def as_array(objects: list[Any]) -> NDArray[np.object_]:
    """Return a list as an array of objects (N,)."""
    return np.fromiter(objects, np.object_, len(objects))


def _as_float(value: float) -> float:
    try:
        return float(value)
    except OverflowError:  # an integer of hundreds of digits
        return np.inf if value > 0 else -np.inf
