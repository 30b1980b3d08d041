"""ROS message definitions (ros1msg, ros2msg) to message types.

A definition is the text of the message's .msg file, followed by those of the types it uses, each
after a line of '=' and a line "MSG: package/Type". A line is "type name [default]", or
"type NAME=value" for a constant, which is not sent. Service events ("..._Event") are stored as
the service's request and response, with '---' between; what is sent is an info and both of them.
"""

from __future__ import annotations

import re

from grounded_trials.formats.messages import Array, Field, Number, Struct, Text, Type
from grounded_trials.formats.protobuf_schema import BadSchema

_COMMON = {
    "bool": "b1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
    "char": "u1",
}
_FIELD = re.compile(
    r"^(?P<type>[A-Za-z][\w/]*)(?P<bound><=\d+)?(?P<array>\[(?:<=)?\d*\])?\s+(?P<name>[A-Za-z]\w*)"
    r"\s*(?P<constant>=(?!=))?"
)
_SEPARATOR = re.compile(r"^={3,}\s*$", re.MULTILINE)
DEPTH_LIMIT, COUNT_LIMIT = 64, 10**8
EVENT = "_Event"

_TIME2 = (("sec", "int32"), ("nanosec", "uint32"))
_INFO = (
    "uint8 event_type\nbuiltin_interfaces/Time stamp\nchar[16] client_gid\nint64 sequence_number"
)


def parse_ros(text: str, name: str, *, ros1: bool) -> Struct:
    """The message type `name` that a definition describes.

    Raises:
        BadSchema: if it uses a type it does not define, or is no definition.
    """
    first, *others = _SEPARATOR.split(text.replace("\r\n", "\n"))
    texts = {} if ros1 else {"builtin_interfaces/Time": _lines(_TIME2)}
    texts.setdefault("builtin_interfaces/Duration", _lines(_TIME2))
    for part in others:
        head, _, body = part.lstrip("\n").partition("\n")
        kind, _, full = head.partition(":")
        if kind.strip() != "MSG":
            raise BadSchema(
                f"its definition has a part '{head[:40]}', expected 'MSG: package/Type'"
            )
        texts[_short(full.strip())] = body
    root = _short(name)
    texts[root] = first
    if not ros1 and name.endswith(EVENT):
        _service_event(texts, root)
    return _Types(texts, ros1).struct(root, 0)


def _lines(fields: tuple[tuple[str, str], ...]) -> str:
    return "\n".join(f"{kind} {name}" for name, kind in fields)


def _short(name: str) -> str:
    """package/Type of package/msg/Type."""
    parts = name.split("/")
    return f"{parts[0]}/{parts[-1]}" if len(parts) == 3 else name


def _service_event(texts: dict[str, str], root: str) -> None:
    """Replaces "request --- response" by what a service event really holds."""
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


class _Types:
    def __init__(self, texts: dict[str, str], ros1: bool) -> None:
        self.texts, self.ros1 = texts, ros1
        self.built: dict[str, Struct] = {}

    def struct(self, name: str, depth: int) -> Struct:
        if name in self.built:
            return self.built[name]
        if depth > DEPTH_LIMIT:
            raise BadSchema(f"its definition of '{name}' contains itself")
        package = name.split("/")[0] if "/" in name else ""
        fields = []
        for line in self.texts[name].split("\n"):
            stripped = line.strip()
            if not stripped or stripped.startswith("#"):
                continue
            match = _FIELD.match(stripped)
            if not match:
                raise BadSchema(f"its definition has a line that is no field: '{stripped[:60]}'")
            if match["constant"]:
                continue
            fields.append(Field(match["name"], self.type(match, package, depth)))
        self.built[name] = Struct(name, tuple(fields))
        return self.built[name]

    def type(self, match: re.Match[str], package: str, depth: int) -> Type:
        kind = self.named(match["type"], package, depth)
        array = match["array"]
        if array is None:
            return kind
        count = array[1:-1]
        if not count or count.startswith("<="):
            return Array(kind)
        if int(count) > COUNT_LIMIT:
            raise BadSchema(f"its field '{match['name']}' has {count} items")
        return Array(kind, int(count))

    def named(self, name: str, package: str, depth: int) -> Type:
        if name in _COMMON:
            return Number(_COMMON[name])
        if name == "byte":
            return Number("i1" if self.ros1 else "u1")
        if name in ("string", "wstring"):
            return Text(1 if name == "string" else 0)
        if self.ros1 and name in ("time", "duration"):
            kind = "u4" if name == "time" else "i4"
            return Struct(name, (Field("sec", Number(kind)), Field("nsec", Number(kind))))
        names = [_short(name), f"{package}/{name}", f"std_msgs/{name}"]
        for full in names if "/" not in name else names[:1]:
            if full in self.texts:
                return self.struct(full, depth + 1)
        raise BadSchema(f"its definition uses '{name}', which it does not define")
