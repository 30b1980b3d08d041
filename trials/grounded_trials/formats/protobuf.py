"""Protobuf: messages of doubles as grounded writes them, and any others by Google's library.

The import of that library takes longer than reading a trial, so messages of ours are encoded here,
and read by `uniform_doubles` if all have one form. Ours hold doubles, numbered from 1. Zeros are
written as well, so that all messages of a channel have the same length and -0.0 is preserved.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grounded.frozen import Array
from grounded_trials.formats.bad import BadSchema
from grounded_trials.formats.mcap_records import Schema, windows

VARINT, FIXED64, BYTES = 0, 1, 2  # what follows a tag
DOUBLE, OPTIONAL, REPEATED = 1, 1, 3  # in google/protobuf/descriptor.proto


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


def file_descriptor_set(message: str, names: Sequence[str], *, repeated: bool = False) -> bytes:
    """Return a serialised FileDescriptorSet of one proto3 message of doubles, numbered from 1."""
    label = REPEATED if repeated else OPTIONAL
    fields = [
        _bytes(1, name.encode()) + _integer(3, number) + _integer(4, label) + _integer(5, DOUBLE)
        for number, name in enumerate(names, start=1)
    ]
    definition = _bytes(1, message.encode()) + b"".join(_bytes(2, field) for field in fields)
    name = f"grounded/{message}.proto".encode()
    file = _bytes(1, name) + _bytes(2, b"grounded") + _bytes(4, definition) + _bytes(12, b"proto3")
    return _bytes(1, file)


def _bytes(number: int, data: bytes) -> bytes:
    return varint(number << 3 | BYTES) + varint(len(data)) + data


def _integer(number: int, value: int) -> bytes:
    return varint(number << 3 | VARINT) + varint(value)


def encode_doubles(values: Array) -> list[bytes]:
    """Return messages of doubles for rows of numbers (N, count)."""
    tags = [double_tag(number) for number in range(1, values.shape[1] + 1)]
    return _joined(list(zip(tags, values.T[:, :, None], strict=True)))


def encode_lists(lists: Sequence[Array]) -> list[bytes]:
    """Return messages of packed lists of doubles, (N, count) per field, a row for each message.

    A field with count 0 is left out.
    """
    fields = enumerate(lists, start=1)
    return _joined([(doubles_tag(n, v.shape[1]), v) for n, v in fields if v.shape[1]])


def _joined(fields: Sequence[tuple[bytes, Array]]) -> list[bytes]:
    """Return messages of fields, each a constant prefix followed by the row's doubles (N, ...)."""
    parts = list[np.ndarray[Any, np.dtype[np.uint8]]]()
    for prefix, values in fields:
        data = np.ascontiguousarray(values, dtype="<f8").view(np.uint8)
        parts += [np.tile(np.frombuffer(prefix, np.uint8), (len(values), 1)), data]
    return [row.tobytes() for row in np.hstack(parts)]


def uniform_doubles(
    buffer: bytes,
    start: NDArray[np.int64],
    end: NDArray[np.int64],
    fields: Sequence[tuple[bytes, int]],
) -> list[Array] | None:
    """Decode messages that all have exactly these fields in this order, as ours have.

    Message i of N is buffer[start[i]:end[i]]; a field is its tag, and the number of doubles after
    it. Returns the numbers of each field, (N, count); None if the messages differ from this.
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


_OWN_FIELD = re.compile(rb"\n[\x01-\x7f]([!-~\x80-\xff]+)\x18.{1,2} ([\x01\x03])\(\x01", re.DOTALL)


def numbers_in(schema: Schema) -> dict[str, tuple[int, bool]]:
    """Return the keys of a message type's numbers, and whether they are lists, by their names.

    A definition of ours is known without the library, verified by writing it again.
    """
    own = _OWN_FIELD.findall(schema.data)
    names = [name.decode("utf-8", "replace") for name, _ in own]
    repeated = bool(own) and own[0][1] == b"\3"
    written = file_descriptor_set(schema.name.removeprefix("grounded."), names, repeated=repeated)
    if written == schema.data and schema.name.startswith("grounded."):
        return {name: (i, repeated) for i, name in enumerate(names, start=1)}
    from google.protobuf.descriptor_pb2 import DescriptorProto
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field

    texts = Field.TYPE_STRING, Field.TYPE_BYTES, Field.TYPE_MESSAGE, Field.TYPE_GROUP
    described = DescriptorProto()
    message_class(schema.data, schema.name).DESCRIPTOR.CopyToProto(described)
    return {
        unspelled(one.name): (one.number, one.label == Field.LABEL_REPEATED)
        for one in described.field
        if one.type not in texts
    }


@lru_cache(maxsize=256)
def message_class(definition: bytes, name: str) -> Any:
    """Return the class of the messages `name` of a serialised FileDescriptorSet.

    Its fields have the names of `spelled`, since the library takes ASCII names only.
    """
    from google.protobuf import descriptor_pool, message_factory
    from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
    from google.protobuf.message import DecodeError

    pool = descriptor_pool.DescriptorPool()

    def add(file: FileDescriptorProto) -> None:  # after the files that it needs
        for needed in [one for one in file.dependency if one in files]:
            add(files.pop(needed))
        for message in file.message_type:
            for field in message.field:
                field.name = spelled(field.name)
        pool.Add(file)

    try:
        files = {file.name: file for file in FileDescriptorSet.FromString(definition).file}
        while files:
            add(files.pop(next(iter(files))))
        return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
    except (DecodeError, TypeError, ValueError, KeyError, RecursionError) as error:
        why = " ".join(str(error).split())[:80]
        raise BadSchema("decode", what="definition", why=why) from None


def spelled(name: str) -> str:
    """Return a field's name in ASCII."""
    return name if name.isascii() else f"x_{name.encode().hex()}"


def unspelled(name: str) -> str:
    """Return the name that `spelled` wrote."""
    coded = re.fullmatch(r"x_((?:[0-9a-f]{2})+)", name)
    return bytes.fromhex(coded[1]).decode("utf-8", "replace") if coded else name
