"""CDR (ROS 2) and ROS 1 messages as nodes: one cursor per message, moved over the type's fields.

In both encodings the fields follow each other. CDR aligns every number to a multiple of its size
(at most 8, or 4 in its second version), counted from the start of the message; ROS 1 does not. The
size of a value without texts and lists therefore depends only on its start modulo 8. A table of
eight sizes moves all cursors over it at once, and doubling the table moves them over 2^k items.
Lists and texts begin with their count. Fields that are not on the path are skipped, not decoded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from grounded_trials.formats.bad import BadMessage, BadPath
from grounded_trials.formats.mcap_records import windows
from grounded_trials.formats.messages import (
    Array,
    Bools,
    Field,
    Floats,
    Ints,
    Node,
    Number,
    Struct,
    Text,
    Type,
    choose_items,
    texts_equal,
)

ZSTD = b"\x28\xb5\x2f\xfd"  # start of a message that rosbag2 compressed individually
SIZE_LIMIT = 2**40  # [bytes] size of a type, so that positions don't overflow


@dataclass(frozen=True)
class Coding:
    """How numbers are laid out in a message."""

    align: int  # largest alignment of numbers [bytes]
    order: str  # "<" or ">"
    terminated: bool  # texts end with a zero byte, and an empty struct is one byte


ROS1 = Coding(1, "<", False)
_KINDS = {
    0: Coding(8, ">", True),
    1: Coding(8, "<", True),
    6: Coding(4, ">", True),
    7: Coding(4, "<", True),
}


@dataclass(frozen=True, eq=False)
class _CdrNode(Node):
    """Row i is the value of `type` at buffer[pos[i]], in a message from base[i] to end[i]."""

    base: Ints
    pos: Ints
    end: Ints
    buffer: bytes
    coding: Coding

    def field(self, name: str) -> _CdrNode:
        assert isinstance(self.type, Struct)
        node = self
        for part in _before(self.type, name, self.coding):
            node = node._at(node._after(part))
        return replace(node, type=self.type.by_name[name].type)

    def items(self, start: int, stop: int) -> _CdrNode:
        assert isinstance(self.type, Array)
        item = self.type.item
        counts, body = self._counts()
        row, index = choose_items(counts, start, stop)
        inside = replace(body.pick(row), type=item)
        sizes = _sizes(item, self.coding)
        if sizes is not None:
            return inside._at(inside._over(sizes, index))
        return inside._at(body._positions(item, row, index))

    def numbers(self) -> Floats:
        assert isinstance(self.type, Number)
        kind = "u1" if self.type.kind == "b1" else self.type.kind
        values = self._aligned(self.type.size)._read(kind)
        return np.asarray(values != 0 if self.type.kind == "b1" else values, dtype=np.float64)

    def equals(self, text: str) -> Bools:
        counts, body = self._counts()
        length = counts.copy()
        if self.coding.terminated:
            octets = np.frombuffer(self.buffer, dtype=np.uint8)
            last = octets[np.maximum(body.pos + counts - 1, 0)]
            length -= (counts > 0) & (last == 0)
        return texts_equal(self.buffer, body.pos, length, text.encode())

    def texts(self) -> list[str]:
        counts, body = self._counts()
        places = zip(body.pos.tolist(), counts.tolist(), strict=True)
        parts = (self.buffer[at : at + count] for at, count in places)
        return [part.rstrip(b"\0").decode("utf-8", "replace") for part in parts]

    def _at(self, pos: Ints) -> _CdrNode:
        return replace(self, pos=pos)

    def _aligned(self, size: int) -> _CdrNode:
        multiple = min(size, self.coding.align)
        return self._at(self.pos + ((self.base - self.pos) & (multiple - 1)))

    def _read(self, kind: str) -> NDArray[np.generic]:
        """Read the numbers at the cursors, which must be aligned."""
        size = int(kind[1:])
        self._check(self.pos + size)
        return windows(self.buffer, self.coding.order + kind)[self.pos]

    def _check(self, stop: Ints) -> None:
        over = (stop > self.end) | (self.pos < self.base)
        if over.any():
            raise BadMessage(self.rows[over][0], "decode", what="message", at=str(self.type))

    def _counts(self) -> tuple[Ints, _CdrNode]:
        """Return the item counts of lists or texts, and the cursors at the first items."""
        if isinstance(self.type, Array) and self.type.count is not None:
            return np.full(len(self.rows), self.type.count, dtype=np.int64), self
        node = self._aligned(4)
        counts = node._read("u4").astype(np.int64)
        body = node._at(node.pos + 4)
        body._check(body.pos + counts)  # an item has at least one byte
        return counts, body

    def _after(self, part: Type | _Table) -> Ints:
        """Return where a value of this type ends."""
        if isinstance(part, _Table):
            return self._over(part, None)
        node = replace(self, type=part)
        if isinstance(part, Struct):
            for inner in _parts(part.fields, self.coding):
                node = node._at(node._after(inner))
            return node.pos
        assert isinstance(part, Text | Array)
        counts, body = node._counts()
        if isinstance(part, Text):
            if part.unit == 0:
                raise BadPath("decode", what="wstring")
            return body.pos + counts
        sizes = _sizes(part.item, self.coding)
        if sizes is not None:
            return body._over(sizes, counts)
        return body._positions(part.item, np.arange(len(counts)), counts)

    def _over(self, table: _Table, count: Ints | None) -> Ints:
        """Return the cursors moved over `count` values of fixed size (None: one)."""
        if count is None:
            return np.asarray(self.pos + table.once[(self.pos - self.base) & 7])
        pos = self.pos.copy()
        for bit in range(int(count.max(initial=0)).bit_length()):
            at = (count >> bit) & 1 != 0
            pos[at] += table.times(bit)[(pos[at] - self.base[at]) & 7]
        self._check(pos)
        return pos

    def _positions(self, item: Type, row: Ints, index: Ints) -> Ints:
        """Return the position of item index[j] of the list at the cursor of row[j]."""
        last = int(index.max(initial=0))
        found, pos, node = self.pos[row], self.pos.copy(), replace(self, type=item)
        order = np.argsort(index, kind="stable")
        ends = np.searchsorted(index[order], np.arange(last + 1), "right")
        furthest = np.zeros(len(pos), dtype=np.int64)
        np.maximum.at(furthest, row, index)
        longest_first = np.argsort(-furthest, kind="stable")
        lives = np.searchsorted(-furthest[longest_first], -np.arange(last), "left")
        for i in range(last):
            live = longest_first[: lives[i]]
            pos[live] = node.pick(live)._at(pos[live])._after(item)
            here = order[ends[i] : ends[i + 1]]
            found[here] = pos[row[here]]
        return found


class _Table:
    """Sizes of a value for each start modulo 8, and of 2^k consecutive values."""

    def __init__(self, once: tuple[int, ...]) -> None:
        if max(once) > SIZE_LIMIT:
            raise BadPath("decode", what="type", why=f"> {SIZE_LIMIT} bytes")
        self.once = np.array(once, dtype=np.int64)
        self.powers = [self.once]

    def times(self, k: int) -> Ints:
        """Return the sizes of 2^k consecutive values, (8,)."""
        while len(self.powers) <= k:
            half = self.powers[-1]
            self.powers.append(half + half[(np.arange(8) + half) & 7])
        return self.powers[k]


@lru_cache(maxsize=4096)
def _sizes(type: Type, coding: Coding) -> _Table | None:
    """Return the table of a type of fixed size; None if it contains texts or lists."""
    if isinstance(type, Number):
        multiple = min(type.size, coding.align)
        return _Table(tuple((-m) % multiple + type.size for m in range(8)))
    if isinstance(type, Array) and type.count is not None:
        item = _sizes(type.item, coding)
        if item is None:
            return None
        total = np.zeros(8, dtype=np.int64)
        for bit in range(type.count.bit_length()):
            if type.count >> bit & 1 and total.max() <= SIZE_LIMIT:
                total = total + item.times(bit)[(np.arange(8) + total) & 7]
        return _Table(tuple(total.tolist()))
    if not isinstance(type, Struct):
        return None
    if not type.fields:
        return _Table((int(coding.terminated),) * 8)
    first, *others = _parts(type.fields, coding)
    return first if isinstance(first, _Table) and not others else None


@lru_cache(maxsize=4096)
def _before(type: Struct, name: str, coding: Coding) -> tuple[Type | _Table, ...]:
    """Return the parts that a cursor moves over to reach a field."""
    index = [field.name for field in type.fields].index(name)
    return _parts(type.fields[:index], coding)


@lru_cache(maxsize=4096)
def _parts(fields: tuple[Field, ...], coding: Coding) -> tuple[Type | _Table, ...]:
    """Group fields into the fewest steps: adjacent fields of fixed size share one table."""
    parts: list[Type | _Table] = []
    for field in fields:
        sizes = _sizes(field.type, coding)
        if sizes is None:
            parts.append(field.type)
        elif parts and isinstance(parts[-1], _Table):
            before = parts[-1].once
            total = before + sizes.once[(np.arange(8) + before) & 7]
            parts[-1] = _Table(tuple(total.tolist()))
        else:
            parts.append(sizes)
    return tuple(parts)


def ros1_messages(buffer: bytes, type: Struct, start: Ints, end: Ints) -> Node:
    """Return the root node of ROS 1 messages of one type at buffer[start[i]:end[i]]."""
    return _CdrNode(type, np.arange(len(start)), start, start, end, buffer, ROS1)


def cdr_messages(buffer: bytes, type: Struct, start: Ints, end: Ints) -> Node:
    """Return the root node of CDR messages of one type at buffer[start[i]:end[i]].

    Raises:
        BadMessage: for a message without a header, or in a variant of CDR that can't be read.
    """
    short = end - start < 4
    if short.any():
        raise BadMessage(int(np.argmax(short)), "decode", what="message", at="header")
    octets = np.frombuffer(buffer, dtype=np.uint8)
    kinds = octets[start + 1]
    if len(kinds):
        other = kinds != kinds[0]
        if other.any():
            raise BadMessage(int(np.argmax(other)), "decode", what="CDR")
        if buffer[start[0] : start[0] + 4] == ZSTD:
            raise BadMessage(0, "decode", what="CDR")
        if int(kinds[0]) not in _KINDS or octets[start].any():
            raise BadMessage(0, "decode", what="CDR", at=str(int(kinds[0])))
    coding = _KINDS[int(kinds[0])] if len(kinds) else _KINDS[1]
    base = start + 4
    return _CdrNode(type, np.arange(len(start)), base, base, end, buffer, coding)
