"""Parse definitions of message types: protobuf, ros1msg, ros2msg, ros2idl, omgidl.

A protobuf definition is a FileDescriptorSet, itself encoded in protobuf, which Google's library
reads. Those that grounded writes are recognised without it, since importing it takes longer than
reading a trial.

A ROS definition is the text of the message's .msg file, followed by those of the types it uses,
each after a line of '=' and a line "MSG: package/Type". A line is "type name [default]", or
"type NAME=value" for a constant, which is not sent. Service events ("..._Event") are defined as
the service's request and response with '---' between them; the message has an info and both.

The parser of rosbags (0.11.9) for ROS definitions is not used: it refuses service events, Windows
line ends and constants in lower case, and takes 20 to 40 times as long. That for IDL is. With
ros2idl several files follow each other, each after a line of '=' and a line "IDL: package/Type".
What it would pass over without a word is refused here: optional members, base types, unions, maps;
so are lists in lists, with which it takes seconds for a line.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

from grounded_trials.formats.bad import BadSchema
from grounded_trials.formats.mcap_records import Schema
from grounded_trials.formats.mcap_writer import file_descriptor_set
from grounded_trials.formats.messages import (
    COUNT_LIMIT,
    DEPTH_LIMIT,
    NUMBERS,
    Array,
    Field,
    Number,
    Struct,
    Text,
    Type,
)


def struct_of(schema: Schema) -> Struct:
    """Return the message type that a schema defines.

    Raises:
        BadSchema: if it can't be parsed, or its language is unknown.
    """
    if schema.encoding == "protobuf":
        return _own_type(schema.data, schema.name) or parse_protobuf(schema.data, schema.name)
    text = schema.data.decode("utf-8", "replace")
    if schema.encoding in ("ros1msg", "ros2msg"):
        return parse_ros(text, schema.name, ros1=schema.encoding == "ros1msg")
    if schema.encoding in ("ros2idl", "omgidl"):
        return parse_idl(text, schema.name)
    raise BadSchema("decode", what="schema language", at=schema.encoding)


_OWN_FIELD = re.compile(rb"\n[\x01-\x7f]([!-~]+)\x18.{1,2} ([\x01\x03])\(\x01", re.DOTALL)


def _own_type(data: bytes, name: str) -> Struct | None:
    """Return the type of a channel written by grounded, verified by writing it again; else None."""
    found = _OWN_FIELD.findall(data)
    names = [field.decode() for field, _ in found]
    repeated = bool(found) and found[0][1] == b"\3"
    own = file_descriptor_set(name.removeprefix("grounded."), names, repeated=repeated)
    if own != data or not name.startswith("grounded."):
        return None
    kind = Array(Number("f8")) if repeated else Number("f8")
    return Struct(name, tuple(Field(n, kind, i) for i, n in enumerate(names, start=1)), data)


_PROTOBUF: dict[int, Type] = {
    1: Number("f8"),
    2: Number("f4"),
    3: Number("i8"),
    4: Number("u8"),
    5: Number("i4"),
    6: Number("u8"),
    7: Number("u4"),
    8: Number("b1"),
    9: Text(),
    12: Text(),
    13: Number("u4"),
    14: Number("i4"),
    15: Number("i4"),
    16: Number("i8"),
    17: Number("i4"),
    18: Number("i8"),
}
MESSAGE, REPEATED = 11, 3
NUMBER_LIMIT = 2**29  # largest number of a field, exclusive


def parse_protobuf(data: bytes, name: str) -> Struct:
    """Return message type `name` (with package, without leading dot) of a FileDescriptorSet.

    Raises:
        BadSchema: if the set is damaged or does not define what it uses.
    """
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.message import DecodeError

    types = _ProtobufTypes()
    try:
        for file in FileDescriptorSet.FromString(data).file:
            types.collect(file.message_type, file.package)
        return replace(types.struct(name), definition=data)
    except (DecodeError, TypeError, ValueError, RecursionError) as error:
        raise BadSchema("decode", what="definition", why="damaged", at=str(error)[:80]) from None


class _ProtobufTypes:
    """Builds each message type once; a recursive one refers to itself."""

    def __init__(self) -> None:
        self.messages: dict[str, Any] = {}
        self.built: dict[str, Struct] = {}

    def collect(self, messages: Iterable[Any], scope: str) -> None:
        for message in messages:
            full = f"{scope}.{message.name}" if scope else message.name
            self.messages[full] = message
            self.collect(message.nested_type, full)

    def struct(self, name: str) -> Struct:
        if name in self.built:
            return self.built[name]
        if name not in self.messages:
            raise BadSchema("decode", what="definition", why="lacks", at=name)
        self.built[name] = built = Struct(name, ())
        fields = tuple(self.field(field) for field in self.messages[name].field)
        object.__setattr__(built, "fields", fields)
        return built

    def field(self, field: Any) -> Field:
        if not isinstance(field.name, str):
            raise ValueError("name")
        code = field.type if field.HasField("type") else 0
        if code != MESSAGE and code not in _PROTOBUF:
            raise BadSchema("decode", what="definition", why="refused", at=field.name)
        if not 0 < field.number < NUMBER_LIMIT:
            raise BadSchema("decode", what="definition", why="unexpected", at=field.name)
        kind: Type = _PROTOBUF.get(code) or self.struct(field.type_name.lstrip("."))
        if field.label == REPEATED:
            return Field(field.name, Array(kind), field.number)
        return Field(field.name, kind, field.number)


_IDL_FILE = re.compile(r"^={3,}[^\S\n]*\nIDL:[^\n]*$", re.MULTILINE)
_UNREAD = re.compile(
    r'//[^\n]*|/\*.*?(?:\*/|\Z)|"(?:[^"\\\n]|\\.)*"', re.DOTALL
)  # comments and texts
_NOT_PLAIN = re.compile(
    r"@(?:optional|mutable)|\b(?:union|map|bitset|bitmask|any|interface|valuetype|long double)\b"
    r"|\bstruct\s+\w+\s*:|(?:sequence\s*<\s*){2}|\]\s*\[|(?:\bmodule\s+\w+\s*\{\s*){16}"
)
_DIRECTIVE = re.compile(r"^[^\S\n]*#[^\n]*$", re.MULTILINE)
_ENUM = re.compile(r"\benum\s+(\w+)")
IDL_LIMIT = 2**18  # characters of an IDL definition


def parse_idl(text: str, name: str) -> Struct:
    """Return the message type `name` (with / or :: between its parts) of an IDL text.

    Raises:
        BadSchema: if the text is damaged, or uses an unsupported feature.
    """
    from rosbags.typesys import TypesysError, get_types_from_idl

    text = _DIRECTIVE.sub("", text)
    bare = _UNREAD.sub(" ", text[:IDL_LIMIT])
    if len(text) > IDL_LIMIT or (refused := _NOT_PLAIN.search(bare)):
        at = refused[0] if len(text) <= IDL_LIMIT and refused else f"{len(text)} characters"
        raise BadSchema("decode", what="definition", why="refused", at=at[:40])
    structs: dict[str, Any] = {}
    try:
        for part in _IDL_FILE.split(text):
            structs |= get_types_from_idl(part) if part.strip() else {}
    except (TypesysError, RecursionError, AssertionError, ValueError, LookupError) as error:
        at = " ".join(str(error).split())[:80]
        raise BadSchema("decode", what="definition", why="damaged", at=at) from None
    types = _IdlTypes(structs, {*_ENUM.findall(bare)})
    return types.struct(name.replace("::", "/"), 0)


class _Types(ABC):
    """Builds each message type of a definition once."""

    def __init__(self) -> None:
        self.built: dict[str, Struct] = {}

    @abstractmethod
    def fields(self, name: str, depth: int) -> Iterator[Field]:
        """Yield the fields of a type; KeyError if it is not defined."""

    def struct(self, name: str, depth: int) -> Struct:
        if name not in self.built:
            if depth > DEPTH_LIMIT:
                raise BadSchema("decode", what="definition", why="nested", at=name[:80])
            try:
                self.built[name] = Struct(name, tuple(self.fields(name, depth)))
            except KeyError as error:
                at = str(error.args[0])[:80]
                raise BadSchema("decode", what="definition", why="lacks", at=at) from None
        return self.built[name]

    @staticmethod
    def count(text: int | str) -> int:
        """Return the number of an array's items."""
        if len(str(text)) > 9 or not 0 <= int(text) <= COUNT_LIMIT:
            raise BadSchema("decode", what="definition", why="long", at=str(text)[:20])
        return int(text)


class _IdlTypes(_Types):
    """The types in rosbags' descriptions; an enum is a number."""

    def __init__(self, structs: dict[str, Any], enums: set[str]) -> None:
        super().__init__()
        self.structs, self.enums = structs, enums

    def fields(self, name: str, depth: int) -> Iterator[Field]:
        for key, described in self.structs[name][1]:
            # ROS gives a struct without members a dummy member of one byte.
            if key != "structure_needs_at_least_one_member":
                yield Field(key, self.type(described, depth))

    def type(self, described: Any, depth: int) -> Type:
        kind, inner = described[0].name, described[1]
        if kind in ("ARRAY", "SEQUENCE"):
            item, count = inner
            most = self.count(count)
            return Array(self.type(item, depth), most if kind == "ARRAY" else None)
        if kind == "BASE":
            named = NUMBERS | {"octet": Number("u1"), "byte": Number("u1")}
            texts = {"string": Text(1), "wstring": Text(0)}
            if (found := (named | texts).get(inner[0])) is None:
                raise BadSchema("decode", what="definition", why="refused", at=inner[0])
            return found
        if inner not in self.structs and inner.rpartition("/")[2] in self.enums:
            return Number("u4")
        return self.struct(inner, depth + 1)


_FIELD = re.compile(
    r"^(?P<type>[A-Za-z][\w/]*)(?P<bound><=\d+)?(?P<array>\[(?:<=)?\d*\])?\s+(?P<name>[A-Za-z]\w*)"
    r"\s*(?P<constant>=(?!=))?"
)
_SEPARATOR = re.compile(r"^={3,}\s*$", re.MULTILINE)
EVENT = "_Event"
_TIME = "int32 sec\nuint32 nanosec"
_INFO = (
    "uint8 event_type\nbuiltin_interfaces/Time stamp\nchar[16] client_gid\nint64 sequence_number"
)


def parse_ros(text: str, name: str, *, ros1: bool) -> Struct:
    """Return the message type `name` of a ROS definition.

    Raises:
        BadSchema: if it uses a type that it does not define, or is not a definition.
    """
    first, *others = _SEPARATOR.split(text.replace("\r\n", "\n"))
    texts = {"builtin_interfaces/Duration": _TIME}
    if not ros1:
        texts["builtin_interfaces/Time"] = _TIME
    for part in others:
        head, _, body = part.lstrip("\n").partition("\n")
        kind, _, full = head.partition(":")
        if kind.strip() != "MSG":
            raise BadSchema("decode", what="definition", why="unexpected", at=head[:40])
        texts[_short(full.strip())] = body
    root = _short(name)
    texts[root] = first
    if not ros1 and name.endswith(EVENT):
        _service_event(texts, root)
    return _RosTypes(texts, ros1).struct(root, 0)


def _short(name: str) -> str:
    """Return package/Type for package/msg/Type."""
    parts = name.split("/")
    return f"{parts[0]}/{parts[-1]}" if len(parts) == 3 else name


def _service_event(texts: dict[str, str], root: str) -> None:
    """Replace "request --- response" by the fields that a service event message has."""
    parts = re.split(r"^---\s*$", texts[root], maxsplit=1, flags=re.MULTILINE)
    if len(parts) == 1:
        return
    base = root[: -len(EVENT)]
    texts[f"{base}_Request"], texts[f"{base}_Response"] = parts
    texts.setdefault("service_msgs/ServiceEventInfo", _INFO)
    texts[root] = (
        f"service_msgs/ServiceEventInfo info\n{base}_Request[<=1] request\n"
        f"{base}_Response[<=1] response"
    )


class _RosTypes(_Types):
    """The types of the texts of messages, by package/Type."""

    def __init__(self, texts: dict[str, str], ros1: bool) -> None:
        super().__init__()
        self.texts, self.ros1 = texts, ros1

    def fields(self, name: str, depth: int) -> Iterator[Field]:
        package = name.split("/")[0] if "/" in name else ""
        for line in map(str.strip, self.texts[name].split("\n")):
            if not line or line.startswith("#"):
                continue
            if (match := _FIELD.match(line)) is None:
                raise BadSchema("decode", what="definition", why="unexpected", at=line[:60])
            if not match["constant"]:
                yield Field(match["name"], self.type(match, package, depth))

    def type(self, match: re.Match[str], package: str, depth: int) -> Type:
        kind, array = self.named(match["type"], package, depth), match["array"]
        if array is None:
            return kind
        count = array[1:-1]
        return Array(kind, None if not count or count.startswith("<=") else self.count(count))

    def named(self, name: str, package: str, depth: int) -> Type:
        if name in NUMBERS:
            return NUMBERS[name]
        if name == "byte":
            return Number("i1" if self.ros1 else "u1")
        if name in ("string", "wstring"):
            return Text(1 if name == "string" else 0)
        if self.ros1 and name in ("time", "duration"):
            kind = "u4" if name == "time" else "i4"
            return Struct(name, (Field("sec", Number(kind)), Field("nsec", Number(kind))))
        names = [_short(name), f"{package}/{name}", f"std_msgs/{name}"]
        found = [full for full in (names if "/" not in name else names[:1]) if full in self.texts]
        if not found:
            raise BadSchema("decode", what="definition", why="lacks", at=name)
        return self.struct(found[0], depth + 1)
