"""The contents of messages as Python objects, whatever their encoding.

rosbags decodes CDR (ROS 2) and ROS 1 messages, Google's library protobuf, and Python's JSON: one
by one, about 10 us a message. The rows of a table are one object whose numbers are columns.
`path_walk` finds numbers in them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grounded_trials.formats.bad import BadMessage, BadSchema
from grounded_trials.formats.mcap_records import Channel, Messages, Rows, Schema
from grounded_trials.formats.protobuf import message_class, spelled, unspelled

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

PIECE = 2**20  # [bytes] of messages decoded at once, at least one: objects take much memory
ABSENT = object()  # what a message has in place of a field that was not sent


@dataclass(frozen=True, eq=False)
class Decoded:
    """Messages of one topic, or the rows of a table: N in all."""

    objects: Sequence[Any]  # N of them; of a table one
    log_times: Ints  # (N,) [ns]
    publish_times: Ints  # (N,) [ns]
    is_table: bool = False

    @property
    def samples(self) -> Sequence[Any]:
        """The first and the last message, or a table's first row."""
        if not self.is_table:
            return [self.objects[0], self.objects[-1]]
        columns = self.objects[0].items()
        return [{k: [0.0] * len(v) if isinstance(v, list) else 0.0 for k, v in columns}]


@dataclass(frozen=True, eq=False)
class Decoder:
    """Decodes a topic's messages."""

    name: str  # of the message type
    decode: Callable[[bytes], Any] = field(repr=False)

    def parts(self, batch: Messages | Rows) -> Iterator[Decoded]:
        """Yield the contents of messages, or of a table's rows, in pieces.

        Raises:
            BadMessage: for a message that is not of its type, with its index in the piece.
        """
        if isinstance(batch, Rows):
            yield Decoded([_nested(batch.columns)], batch.times, batch.times, is_table=True)
            return
        piece = np.cumsum(batch.ends - batch.starts) // PIECE
        for number in range(int(piece[-1]) + 1 if len(piece) else 0):
            first, last = np.searchsorted(piece, [number, number + 1])
            objects = list[Any]()
            for i in range(first, last):
                try:
                    objects.append(self.decode(batch.buffer[batch.starts[i] : batch.ends[i]]))
                except MemoryError:
                    raise
                except Exception as error:  # each library has its own
                    why = _short(error)
                    raise BadMessage(len(objects), "decode", what="message", why=why) from None
            if objects:
                times = batch.log_times[first:last], batch.publish_times[first:last]
                yield Decoded(objects, *times)


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:80] or type(error).__name__


def _nested(columns: dict[str, Floats]) -> dict[str, Any]:
    """Return columns by name, those called q[0], q[1] ... as a list q."""
    table: dict[str, Any] = {}
    for name, column in columns.items():
        bare, bracket, _ = name.partition("[")
        if bracket and bare not in columns:
            table.setdefault(bare, []).append(column)
        else:
            table[name] = column
    return table


def decoder_of(channel: Channel, schema: Schema | None) -> Decoder:
    """Return the decoder of a channel.

    Raises:
        BadSchema: if its encoding is not one of cdr, ros1, protobuf, json, or its schema is bad.
    """
    encoding, name = channel.encoding, schema.name if schema else ""
    if encoding in ("json", "table"):
        return Decoder(name or encoding, json.loads)
    if encoding not in ("cdr", "ros1", "protobuf"):
        raise BadSchema("decode", what="encoding", at=encoding)
    if schema is None:
        raise BadSchema("decode", what="schema", at=encoding)
    if encoding == "protobuf":
        return Decoder(name, message_class(schema.data, name).FromString)
    return Decoder(name, _ros(schema, encoding))


# What the objects are


def names_in(value: Any) -> tuple[str, ...]:
    """Return the field names of an object, () if it is none."""
    if isinstance(value, dict):
        return tuple(value)
    if is_dataclass(value):
        return tuple(one.name for one in fields(value) if one.name != "__msgtype__")
    described = getattr(value, "DESCRIPTOR", None)
    return tuple(unspelled(one.name) for one in described.fields) if described else ()


def fields_of(values: Sequence[Any], name: str) -> list[Any]:
    """Return a field of objects of one kind; ABSENT where it was not sent."""
    first = next(iter(values), None)
    if first is None or isinstance(first, dict):
        return [v.get(name, ABSENT) if isinstance(v, dict) else ABSENT for v in values]
    if not hasattr(first, "HasField"):
        return [getattr(value, name) for value in values]
    inner = [getattr(value, spelled(name)) for value in values]
    if hasattr(inner[0], "HasField"):
        pairs = zip(values, inner, strict=True)
        return [one if value.HasField(spelled(name)) else ABSENT for value, one in pairs]
    if hasattr(inner[0], "values"):  # a map is a list of entries
        return [[{"key": k, "value": v} for k, v in one.items()] for one in inner]
    return inner


def is_list(value: Any) -> bool:
    """Check whether a value has items."""
    return hasattr(value, "__len__") and not isinstance(value, str | bytes | dict)


# ROS

_TIMES = "int32 sec\nuint32 nanosec\n"  # what definitions leave out
_CONSTANT = re.compile(r"^[ \t]*[a-z]\w*(?:<=\d+)?[ \t]+\w+[ \t]*=(?!=).*$", re.MULTILINE)
_OLD = re.compile(r"^([ \t]*)(?:byte|char)\b", re.MULTILINE)  # read as signed by rosbags
_IDL_FILE = re.compile(r"^={3,}[^\S\n]*\nIDL:[^\n]*$", re.MULTILINE)
_DIRECTIVE = re.compile(r"^[^\S\n]*#[^\n]*$", re.MULTILINE)
_UNREAD = re.compile(
    r'//[^\n]*|/\*.*?(?:\*/|\Z)|"(?:[^"\\\n]|\\.)*"', re.DOTALL
)  # comments and texts
# what rosbags would pass over without a word
_NOT_PLAIN = re.compile(
    r"@(?:optional|mutable)|\b(?:union|map|bitset|bitmask|any|interface|valuetype|long double)\b"
    r"|\bstruct\s+\w+\s*:|(?:sequence\s*<\s*){2}|\]\s*\["
)


def _ros(schema: Schema, encoding: str) -> Callable[[bytes], Any]:
    """Return what decodes the messages of a ROS definition.

    Raises:
        BadSchema: if rosbags can't use it.
    """
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    text = schema.data.decode("utf-8", "replace").replace("\r\n", "\n")
    if schema.encoding not in ("ros1msg", "ros2msg", "ros2idl", "omgidl"):
        raise BadSchema("decode", what="schema language", at=schema.encoding)
    idl = schema.encoding.endswith("idl")
    if idl and (refused := _NOT_PLAIN.search(_UNREAD.sub(" ", text))):
        raise BadSchema("decode", what="definition", why="refused", at=refused[0][:40])
    try:
        kinds = (f"builtin_interfaces/msg/{kind}" for kind in ("Time", "Duration"))
        types = {k: one for kind in kinds for k, one in get_types_from_msg(_TIMES, kind).items()}
        if idl:
            for part in _IDL_FILE.split(_DIRECTIVE.sub("", text)):
                types |= get_types_from_idl(part) if part.strip() else {}
        else:
            text = _OLD.sub(r"\1uint8", _CONSTANT.sub("", text))
            types |= get_types_from_msg(text, schema.name)
        name = schema.name.replace("::", "/")
        name = name if name in types else "/msg/".join(name.rsplit("/", 1))
        plain: dict[str, Any] = {kind: ([], fields) for kind, (_, fields) in types.items()}
        if not all(map(_is_plain, plain, (fields for _, fields in plain.values()))):
            raise BadSchema("decode", what="definition", why="refused", at="names")
        store = get_typestore(Stores.EMPTY)
        store.register(plain)
        store.get_msgdef(name)
    except (MemoryError, BadSchema):
        raise
    except Exception as error:  # a parser raises whatever a damaged definition leads to
        raise BadSchema("decode", what="definition", why=_short(error)) from None
    if encoding == "ros1":
        return lambda data: store.deserialize_ros1(data, name)
    return lambda data: store.deserialize_cdr(data, name)


def _is_plain(kind: str, fields: Sequence[tuple[str, Any]]) -> bool:
    """Check that names are identifiers: rosbags writes them into the code of a decoder."""
    names = (*kind.split("/"), *(name for name, _ in fields))
    return all(name.isidentifier() and name.isascii() for name in names)
