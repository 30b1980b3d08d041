"""Read many CDR messages (ROS 2) of one form at once: one message whose numbers are columns.

Messages of a type are of one form if all their lists and texts are equally long, as those of most
sensors are: then every number stands at one place, and a million messages take a second, where
rosbags, which decodes them one by one, takes 20 s. Its definitions say what stands where; a number
begins at a multiple of its size, counted from the end of the four bytes of the head.

Source: OMG, "Common Object Request Broker Architecture", 15.3 (CDR).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

HEAD = 4  # bytes before a message: the order of its bytes
KINDS = {"bool", "float32", "float64"}
KINDS |= {f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)}
TEXT = object()  # in place of texts, which may differ


class Column(np.ndarray[Any, np.dtype[Any]]):
    """A number of N messages, (N,), or a list of k of them, (k, N); no list of one message."""


class Uneven(Exception):
    """Messages are not of one form, or hold what is not known here."""


def columns(
    rows: NDArray[np.uint8], name: str, types: Mapping[str, Any], classes: Mapping[str, Any]
) -> Any:
    """Return messages as one: each number a column (N,), a list of k numbers an array (k, N).

    `rows` are the bytes of N messages (N, length) of a type; `types` and `classes` are the fields
    and the classes of each, as rosbags has them. Raises `Uneven`.
    """
    block = _Block(rows, types, classes)
    message = block.of_type(name)
    if rows.shape[1] - block.at not in range(4):  # some writers fill the last word
        raise Uneven
    return message


class _Block:
    """Messages, read up to the byte `at`."""

    def __init__(
        self, rows: NDArray[np.uint8], types: Mapping[str, Any], classes: Mapping[str, Any]
    ) -> None:
        self.rows, self.types, self.classes = rows, types, classes
        self.at = HEAD
        head = rows[:, :HEAD]
        order = head[0].tobytes()[:2]
        if (head != head[0]).any() or order not in (b"\0\0", b"\0\1"):
            raise Uneven
        self.order: Literal["<", ">"] = "<" if order[1] else ">"

    def of_type(self, name: str) -> Any:
        """Read a message, or one inside it."""
        fields = {field: self.value(kind) for field, kind in self.types[name][1]}
        return self.classes[name](**fields)

    def value(self, described: Sequence[Any]) -> Any:
        """Read what rosbags describes: a number, a text, a message, or a list of them."""
        node, of = described[0].name, described[1]
        if node == "NAME":
            return self.of_type(of)
        if node == "BASE":
            return self.text() if of[0] == "string" else self.numbers(of[0], 1)[0]
        inner, count = of[0], of[1] if node == "ARRAY" else self.count()
        if inner[0].name == "BASE" and inner[1][0] != "string":
            return self.numbers(inner[1][0], count) if count else []
        return [self.value(inner) for _ in range(count)]

    def numbers(self, kind: str, count: int) -> Column:
        """Read `count` numbers (count, N)."""
        if kind not in KINDS:
            raise Uneven
        dtype = np.dtype("uint8" if kind == "bool" else kind).newbyteorder(self.order)
        self.at += -(self.at - HEAD) % dtype.itemsize
        start, self.at = self.at, self.at + count * dtype.itemsize
        if self.at > self.rows.shape[1]:
            raise Uneven
        found = np.ascontiguousarray(self.rows[:, start : self.at]).view(dtype).T
        return (found != 0 if kind == "bool" else found).view(Column)

    def count(self) -> int:
        """Read a length, which must be that of all."""
        (lengths,) = self.numbers("uint32", 1)
        if (lengths != lengths[0]).any():
            raise Uneven
        return int(lengths[0])

    def text(self) -> object:
        """Pass a text."""
        length = self.count()
        self.at += length
        return TEXT
