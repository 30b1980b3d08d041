"""The contents of messages as Python objects, whatever their encoding.

rosbags decodes CDR (ROS 2) and ROS 1 messages, Google's library protobuf, and Python's JSON: one
by one, about 10 us a message. The rows of a table are one object whose numbers are columns, and so
are CDR messages of one form (`cdr`), unless a path needs them one by one.
`path_walk` finds numbers in them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grounded_trials.formats.bad import BadMessage, BadSchema
from grounded_trials.formats.cdr import Column, Uneven, columns
from grounded_trials.formats.mcap_records import Channel, Messages, Rows, Schema, windows
from grounded_trials.formats.protobuf import message_class, spelled, unspelled

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

PIECE = 2**20  # [bytes] of messages decoded at once, at least one: objects take much memory
ABSENT = object()  # what a message has in place of a field that was not sent


@dataclass(frozen=True, eq=False)
class Decoded:
    """Messages of one topic, or the rows of a table: N in all."""

    log_times: Ints  # (N,) [ns]
    publish_times: Ints  # (N,) [ns]
    columns: Any = None  # one object for all, each of its numbers (N,); None: they differ in form
    decode: Callable[[int], Any] | None = None  # returns message i; None: it is a table

    @cached_property
    def objects(self) -> Sequence[Any]:
        """The messages one by one."""
        return [self.message(i) for i in range(len(self.log_times))]

    def message(self, i: int) -> Any:
        """Return message i; raises as `objects` does."""
        assert self.decode is not None
        try:
            return self.decode(i)
        except MemoryError:
            raise
        except Exception as error:  # each library has its own
            raise BadMessage(i, "decode", what="message", why=_short(error)) from None

    @property
    def samples(self) -> Sequence[Any]:
        """The first and the last message, or a table's first row."""
        if self.decode is not None:
            return [self.message(i) for i in (0, -1)]
        columns = self.columns.items()
        return [{k: [0.0] * len(v) if isinstance(v, list) else 0.0 for k, v in columns}]


@dataclass(frozen=True, eq=False)
class Decoder:
    """Decodes a topic's messages."""

    name: str  # of the message type
    decode: Callable[[bytes], Any] = field(repr=False)
    columns: Callable[[NDArray[np.uint8]], Any] | None = field(default=None, repr=False)  # of CDR

    def parts(self, batch: Messages | Rows) -> Iterator[Decoded]:
        """Yield the contents of messages, or of a table's rows, in pieces."""
        if isinstance(batch, Rows):
            yield Decoded(batch.times, batch.times, _nested(batch.columns))
            return
        piece = np.cumsum(batch.ends - batch.starts) // PIECE
        for number in range(int(piece[-1]) + 1 if len(piece) else 0):
            first, last = np.searchsorted(piece, [number, number + 1])
            if first < last:
                starts, ends = batch.starts[first:last], batch.ends[first:last]
                times = batch.log_times[first:last], batch.publish_times[first:last]
                decode = partial(self._message, batch.buffer, starts, ends)
                yield Decoded(*times, self._together(batch.buffer, starts, ends), decode)

    def _message(self, buffer: bytes, starts: Ints, ends: Ints, i: int) -> Any:
        return self.decode(buffer[starts[i] : ends[i]])

    def _together(self, buffer: bytes, starts: Ints, ends: Ints) -> Any:
        """Return messages as one, None if they are not of one form."""
        length = int(ends[0] - starts[0])
        if self.columns is None or not length or (ends - starts != length).any():
            return None
        rows = windows(buffer, f"V{length}")[starts].view(np.uint8).reshape(len(starts), length)
        try:
            return self.columns(rows)
        except Uneven:
            return None


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:80] or type(error).__name__


def _nested(columns: dict[str, Floats]) -> dict[str, Any]:
    """Return columns by name, those called q[0], q[1] ... as a list q."""
    table: dict[str, Any] = {}
    for name, column in columns.items():
        bare, bracket, _ = name.partition("[")
        if bracket and bare not in columns:
            table.setdefault(bare, []).append(column.view(Column))
        else:
            table[name] = column.view(Column)
    return table


def decoder_of(channel: Channel, schema: Schema | None) -> Decoder:
    """Return the decoder of a channel."""
    encoding, name = channel.encoding, schema.name if schema else ""
    if encoding in ("json", "table"):
        return Decoder(name or encoding, json.loads)
    if encoding not in ("cdr", "ros1", "protobuf"):
        raise BadSchema("decode", what="encoding", at=encoding)
    if schema is None:
        raise BadSchema("decode", what="schema", at=encoding)
    if encoding == "protobuf":
        return Decoder(name, message_class(schema.data, name).FromString)
    return _ros(schema, encoding)


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
    if isinstance(value, Column):
        return value.ndim > 1
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


def _ros(schema: Schema, encoding: str) -> Decoder:
    """Return the decoder of the messages of a ROS definition."""
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
        return Decoder(schema.name, lambda data: store.deserialize_ros1(data, name))
    together = partial(columns, name=name, types=plain, classes=store.types)
    return Decoder(schema.name, lambda data: store.deserialize_cdr(data, name), together)


def _is_plain(kind: str, fields: Sequence[tuple[str, Any]]) -> bool:
    """Check that names are identifiers: rosbags writes them into the code of a decoder."""
    names = (*kind.split("/"), *(name for name, _ in fields))
    return all(name.isidentifier() and name.isascii() for name in names)
