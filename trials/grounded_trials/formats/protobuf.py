"""Protobuf messages as nodes, parsed one by one by Google's library, in C: a million in a second.

Its import takes longer than reading a trial. So messages of doubles that grounded writes, all of
one form, are read by `uniform_doubles` without it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from grounded_trials.formats.bad import BadMessage, BadSchema
from grounded_trials.formats.mcap_records import windows
from grounded_trials.formats.messages import (
    Array,
    Floats,
    Ints,
    Node,
    ObjectNode,
    Struct,
    as_array,
)

FIXED64, BYTES = 1, 2


@dataclass(frozen=True)
class _Entry:
    """A key of a map, and its value."""

    f1: Any
    f2: Any

    def HasField(self, name: str) -> bool:
        """Return that both are there."""
        return True


class _ProtobufNode(ObjectNode):
    """An absent field has its default, an absent message no row."""

    def field(self, name: str) -> _ProtobufNode:
        assert isinstance(self.type, Struct)
        known, node = self.type.by_name[name], self
        kind, name = known.type, f"f{known.number}"  # see `message_class`
        if isinstance(kind, Struct):
            node = self.keep(np.array([o.HasField(name) for o in self.objects], dtype=np.bool_))
        inner = [getattr(o, name) for o in node.objects]
        if isinstance(kind, Array) and isinstance(kind.item, Struct):  # a map is a list of entries
            inner = [[*map(_Entry, o, o.values())] if hasattr(o, "values") else o for o in inner]
        return node.among(kind, node.rows, inner)

    def numbers(self) -> Floats:
        return np.array(self.objects, dtype=np.float64)


def protobuf_messages(buffer: bytes, type: Struct, start: Ints, end: Ints) -> Node:
    """Return the root node of messages of one type at buffer[start[i]:end[i]].

    Raises:
        BadMessage: for a message that is not of this type.
        BadSchema: if the library can't use its definition.
    """
    from google.protobuf.message import DecodeError

    assert type.definition is not None
    make, objects = message_class(type.definition, type.name), []
    for i, (a, b) in enumerate(zip(start.tolist(), end.tolist(), strict=True)):
        try:
            objects.append(make.FromString(buffer[a:b]))
        except DecodeError as error:
            raise BadMessage(i, "decode", what="message", why=str(error)) from None
    return _ProtobufNode(type, np.arange(len(objects)), as_array(objects))


@lru_cache(maxsize=256)
def message_class(definition: bytes, name: str) -> Any:
    """Return the class of the messages `name` of a serialised FileDescriptorSet.

    Its fields are called by their numbers, f1 ..., since the library takes ASCII names only.

    Raises:
        BadSchema: if the library can't use it.
    """
    from google.protobuf import descriptor_pool, message_factory
    from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
    from google.protobuf.message import DecodeError

    pool = descriptor_pool.DescriptorPool()

    def add(file: FileDescriptorProto) -> None:  # after the files that it needs
        for needed in [one for one in file.dependency if one in files]:
            add(files.pop(needed))
        _number(file.message_type)
        pool.Add(file)

    try:
        files = {file.name: file for file in FileDescriptorSet.FromString(definition).file}
        while files:
            add(files.pop(next(iter(files))))
        return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
    except (DecodeError, TypeError, ValueError, KeyError, RecursionError) as error:
        raise BadSchema("decode", what="definition", why="damaged", at=str(error)[:80]) from None


def _number(messages: Iterable[Any]) -> None:
    """Call the fields of message descriptions by their numbers, but for those of maps' entries."""
    for message in messages:
        for field in message.field if not message.options.map_entry else ():
            field.name = f"f{field.number}"
            field.ClearField("json_name")
        _number(message.nested_type)


def varint(value: int) -> bytes:
    """Encode a number with seven bits per byte, lowest first; the top bit is set if more follow."""
    parts = bytearray()
    while value > 0x7F:
        parts.append(value & 0x7F | 0x80)
        value >>= 7
    parts.append(value)
    return bytes(parts)


def double_tag(number: int) -> bytes:
    """Return the tag of a double field."""
    return varint(number << 3 | FIXED64)


def doubles_tag(number: int, count: int) -> bytes:
    """Return the tag and length of a packed list of `count` doubles."""
    return varint(number << 3 | BYTES) + varint(8 * count)


def uniform_doubles(
    buffer: bytes, start: Ints, end: Ints, fields: Sequence[tuple[bytes, int]]
) -> list[Floats] | None:
    """Decode messages that all have exactly these fields in this order.

    `mcap_writer` writes such messages.

    Args:
        buffer: the bytes.
        start: where each message starts, (N,).
        end: where it ends, (N,).
        fields: the tag of each field, and the number of doubles after it.

    Returns:
        The numbers of each field, (N, count); None if the messages differ from this.
    """
    sizes = [size for tag, count in fields for size in (len(tag), 8 * count)]
    if not len(start) or (end - start != sum(sizes)).any():
        return None
    block = windows(buffer, f"V{sum(sizes)}")[start].view(np.uint8).reshape(len(start), -1)
    parts = np.split(block, np.cumsum(sizes)[:-1], axis=1)
    for (tag, _), found in zip(fields, parts[::2], strict=True):
        if (found != np.frombuffer(tag, dtype=np.uint8)).any():
            return None
    return [
        np.ascontiguousarray(part).view("<f8").astype(float, copy=False) for part in parts[1::2]
    ]
