"""Protobuf definitions: a serialised FileDescriptorSet to message types.

The set is protobuf itself; of descriptor.proto only what types need is read:
FileDescriptorSet.file 1; File: package 2, message 4, enum 5; Message: name 1, field 2, nested 3;
Field: name 1, number 3, label 4 (3: repeated), type 5, type_name 6, default 7. (Reading it here
costs microseconds; importing google.protobuf, 26 ms.)
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

from grounded_trials.formats.messages import Array, Field, Number, Struct, Text, Type

_NUMBERS = {
    1: Number("f8"),
    2: Number("f4"),
    3: Number("i8"),
    4: Number("u8"),
    5: Number("i4"),
    6: Number("u8", "fixed"),
    7: Number("u4", "fixed"),
    8: Number("b1"),
    13: Number("u4"),
    14: Number("i4"),
    15: Number("i4", "fixed"),
    16: Number("i8", "fixed"),
    17: Number("i4", "zigzag"),
    18: Number("i8", "zigzag"),
}
STRING, GROUP, MESSAGE, BYTES, REPEATED = 9, 10, 11, 12, 3


class BadSchema(Exception):
    """A definition that can't be used; the text says why."""


def parse_descriptor_set(data: bytes, name: str) -> Struct:
    """The message type `name` (with its package, without a leading dot).

    Raises:
        BadSchema: if the set is damaged or does not define what it uses.
    """
    messages: dict[str, bytes] = {}
    try:
        for number, file in _fields(data):
            if number == 1 and isinstance(file, bytes):
                _collect_file(file, messages)
        return _Types(messages).struct(name)
    except (IndexError, ValueError, struct.error, RecursionError) as error:
        raise BadSchema(f"the protobuf definition is damaged: {error}") from None


def _collect_file(file: bytes, messages: dict[str, bytes]) -> None:
    fields = list(_fields(file))
    package = next((_text(v) for n, v in fields if n == 2), "")
    for number, value in fields:
        if number == 4 and isinstance(value, bytes):
            _collect_message(value, package, messages)


def _collect_message(message: bytes, scope: str, messages: dict[str, bytes]) -> None:
    fields = list(_fields(message))
    own = next((_text(v) for n, v in fields if n == 1), "")
    full = f"{scope}.{own}" if scope else own
    messages[full] = message
    for number, value in fields:
        if number == 3 and isinstance(value, bytes):
            _collect_message(value, full, messages)


class _Types:
    """Builds each message type once; a recursive one refers to itself."""

    def __init__(self, messages: dict[str, bytes]) -> None:
        self.messages, self.built = messages, {}  # type: dict[str, bytes], dict[str, Struct]

    def struct(self, name: str) -> Struct:
        if name in self.built:
            return self.built[name]
        if name not in self.messages:
            raise BadSchema(f"the protobuf definition has no message '{name}'")
        built = Struct(name, ())
        self.built[name] = built
        fields = tuple(self.field(v) for n, v in _fields(self.messages[name]) if n == 2)
        object.__setattr__(built, "fields", fields)
        return built

    def field(self, value: bytes | int) -> Field:
        if not isinstance(value, bytes):
            raise BadSchema("the protobuf definition is damaged: a field is no message")
        parts = dict(_fields(value))
        name, number, code = _text(parts.get(1, b"")), parts.get(3, 0), parts.get(5, 0)
        if not isinstance(number, int) or not isinstance(code, int):
            raise BadSchema("the protobuf definition is damaged: a number is no number")
        kind: Type
        if code in _NUMBERS:
            kind = _NUMBERS[code]
        elif code in (STRING, BYTES):
            kind = Text()
        elif code == MESSAGE:
            kind = self.struct(_text(parts.get(6, b"")).lstrip("."))
        else:
            raise BadSchema(f"field '{name}' has protobuf type {code}, which can't be read")
        if parts.get(4) == REPEATED:
            return Field(name, Array(kind), number)
        return Field(name, kind, number, _default(kind, parts.get(7)))


def _default(kind: Type, value: bytes | int | None) -> float:
    if not isinstance(kind, Number) or not isinstance(value, bytes):
        return 0.0
    text = value.decode("utf-8")
    if text in ("true", "false"):
        return float(text == "true")
    try:
        return float(text)
    except ValueError:  # an enum's name; its number would need the enum's definition
        return 0.0


def _text(value: bytes | int) -> str:
    return value.decode("utf-8") if isinstance(value, bytes) else ""


def _fields(data: bytes) -> Iterator[tuple[int, bytes | int]]:
    """The fields of one message: (number, bytes or integer), in wire order."""
    pos, end = 0, len(data)
    while pos < end:
        tag, pos = _varint(data, pos)
        number, wire = tag >> 3, tag & 7
        if wire == 0:
            value, pos = _varint(data, pos)
            yield number, value
            continue
        if wire == 2:
            length, pos = _varint(data, pos)
        elif wire in (1, 5):
            length = 8 if wire == 1 else 4
        else:
            raise ValueError(f"wire type {wire}")
        if pos + length > end:
            raise ValueError("it ends inside a field")
        yield number, data[pos : pos + length]
        pos += length


def _varint(data: bytes, pos: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        octet = data[pos]
        pos += 1
        value |= (octet & 0x7F) << shift
        if octet < 0x80:
            return value, pos
    raise ValueError("a number has more than ten bytes")
