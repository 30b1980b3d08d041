"""CDR, ROS 1, protobuf and JSON: every path finds what a one-by-one decoder finds."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from facts import holding
from grounded_trials.formats.bad import BadMessage, BadPath, BadSchema
from grounded_trials.formats.cdr import cdr_messages, ros1_messages
from grounded_trials.formats.message_path import parse_path
from grounded_trials.formats.messages import (
    Array,
    Dynamic,
    Node,
    Number,
    Struct,
    Text,
    Type,
    json_messages,
)
from grounded_trials.formats.path_walk import bind, evaluate
from grounded_trials.formats.protobuf import protobuf_messages
from grounded_trials.formats.schemas import parse_idl, parse_protobuf, parse_ros
from path_reference import follow

Root = Callable[[bytes, Any, Any], Node]


def decode(read: Any, type: Type, buffer: bytes, start: Any, end: Any) -> Node:
    return read(buffer, type, start, end)


def batch(messages: list[bytes]) -> tuple[bytes, Any, Any]:
    """Messages in one buffer, at odd places."""
    buffer, starts, ends = b"\xff" * 3, [], []
    for message in messages:
        starts.append(len(buffer))
        buffer += message
        ends.append(len(buffer))
        buffer += b"\xee" * 5
    return buffer, np.array(starts, dtype=np.int64), np.array(ends, dtype=np.int64)


def found(messages: list[bytes], type: Type, root: Root, text: str) -> list[list[float]]:
    bound = bind(parse_path(text), type)
    values = evaluate(root(*batch(messages)), bound, stamps=False)
    lists: list[list[float]] = [[] for _ in messages]
    for row, value in zip(values.rows.tolist(), values.values.tolist(), strict=True):
        lists[row].append(value)
    return lists


def paths_of(type: Type, rng: random.Random, filters: bool = True) -> list[str]:
    """Ways to the numbers of a type, with indices, slices and filters by chance."""
    if isinstance(type, Number):
        return [""]
    if isinstance(type, Array):
        a, b = rng.randint(-3, 3), rng.randint(-3, 3)
        chosen = rng.choice([f"[{a}]", f"[{a}:{b}]", "[:]", "[0]", "[-1]"])
        if filters and isinstance(type.item, Struct) and rng.random() < 0.5:
            chosen += filter_of(type.item, rng)
        return [chosen + rest for rest in paths_of(type.item, rng, filters)]
    if isinstance(type, Struct):
        return [
            f".{f.name}{rest}"
            for f in type.fields
            for rest in paths_of(f.type, rng, filters)
            if f.type != Text()
        ]
    return []


def filter_of(type: Struct, rng: random.Random) -> str:
    for field in rng.sample(type.fields, len(type.fields)):
        if isinstance(field.type, Text):
            return f'{{{field.name} {rng.choice(["==", "!="])} "{rng.choice(WORDS)}"}}'
        if isinstance(field.type, Number):
            operator = rng.choice(["==", "!=", "<", "<=", ">", ">="])
            return f"{{{field.name} {operator} {rng.randint(-2, 3)}}}"
    return ""


WORDS = ["", "a", "arm", "left_wheel", "ü"]
NUMBERS = ["bool", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64"]
NUMBERS += ["float32", "float64"]


def random_definition(rng: random.Random) -> dict[str, str]:
    """A message 'x/T0' that uses others, each with a few fields of any kind."""
    count = rng.randint(1, 4)
    texts = {}
    for i in reversed(range(count)):
        inner = [f"T{j}" for j in range(i + 1, count)]
        lines = [f"int32 C{i}={i}"] if rng.random() < 0.3 else []
        for j in range(rng.randint(1, 6)):
            kind = rng.choice([*NUMBERS, "string", *inner, *inner, *inner])
            array = rng.choice(["", "", "", "[]", "[3]", "[<=4]"])
            lines.append(f"{kind}{array} f{j}  # a comment")
        texts[f"x/msg/T{i}"] = "\n".join(lines) + "\n"
    return texts


def concatenated(texts: dict[str, str]) -> str:
    parts = [texts["x/msg/T0"]]
    for name, text in texts.items():
        if name != "x/msg/T0":
            parts.append(f"MSG: x/{name.split('/')[-1]}\n{text}")
    return ("=" * 80 + "\n").join(parts)


def random_value(type: Type, rng: random.Random, make: Callable[[str, dict[str, Any]], Any]) -> Any:
    if isinstance(type, Number):
        if type.kind == "b1":
            return rng.random() < 0.5
        if type.kind[0] == "f":
            return float(np.dtype(type.kind).type(rng.uniform(-3, 3)))
        low = -3 if type.kind[0] == "i" else 0
        return rng.randint(low, 3)
    if isinstance(type, Text):
        return rng.choice(WORDS)
    if isinstance(type, Array):
        count = rng.randint(0, 3) if type.count is None else type.count
        items = [random_value(type.item, rng, make) for _ in range(count)]
        if isinstance(type.item, Number):
            kind = "bool" if type.item.kind == "b1" else type.item.kind
            return np.array(items, dtype=kind)
        return items
    assert isinstance(type, Struct)
    return make(type.name, {f.name: random_value(f.type, rng, make) for f in type.fields})


@pytest.mark.parametrize("seed", range(40))
def test_random_ros_messages_against_rosbags(seed: int) -> None:
    typesys = pytest.importorskip("rosbags.typesys")
    rng = random.Random(seed)
    texts = random_definition(rng)
    for ros1 in (False, True):
        store = typesys.get_typestore(typesys.Stores.EMPTY)
        types = {}
        for name, text in texts.items():
            types.update(typesys.get_types_from_msg(text, name))
        store.register(types)

        def make(name: str, fields: dict[str, Any], store: Any = store) -> Any:
            return store.types[name.replace("x/", "x/msg/")](**fields)

        type = parse_ros(concatenated(texts), "x/T0" if ros1 else "x/msg/T0", ros1=ros1)
        objects = [random_value(type, rng, make) for _ in range(6)]
        write = store.serialize_ros1 if ros1 else store.serialize_cdr
        messages = [bytes(write(o, "x/msg/T0")) for o in objects]
        read = ros1_messages if ros1 else cdr_messages
        for text in paths_of(type, rng):
            mine = found(messages, type, partial(decode, read, type), "/t" + text)
            assert mine == [follow(o, parse_path("/t" + text)) for o in objects], text


def test_big_endian_and_xcdr2() -> None:
    type = parse_ros("uint8 a\nfloat64 b\nstring c\nint64 d", "x/msg/T", ros1=False)
    read = lambda b, s, e: cdr_messages(b, type, s, e)  # noqa: E731
    import struct

    big = b"\0\0\0\0" + struct.pack(">B7xdI4sq", 1, 2.5, 4, b"abc\0", -7)
    xcdr2 = b"\0\x07\0\0" + struct.pack("<B3xdI4sq", 1, 2.5, 4, b"abc\0", -7)
    for message in (big, xcdr2):
        assert found([message], type, read, "/t.d") == [[-7]]
        assert found([message], type, read, '/t{c=="abc"}.b') == [[2.5]]
    with pytest.raises(BadMessage, match=holding("CDR", 3)):
        found([b"\0\3\0\0"], type, read, "/t.d")
    with pytest.raises(BadMessage, match=holding("CDR")) as odd:
        found([big, xcdr2], type, read, "/t.d")
    assert odd.value.message == 1
    with pytest.raises(BadMessage, match="header"):
        found([b"\0\1"], type, read, "/t.d")


@pytest.mark.parametrize("read", [cdr_messages, ros1_messages])
def test_short_and_hostile_ros_messages_are_told(read: Any) -> None:
    text = "float64[] a\nT[] b\nstring c\nfloat64 d\n" + "=" * 80 + "\nMSG: x/T\nstring s\n"
    type = parse_ros(text, "x/M", ros1=read is ros1_messages)
    rng = np.random.default_rng(0)
    root = lambda b, s, e: read(b, type, s, e)  # noqa: E731
    for _ in range(300):
        message = b"\0\1\0\0" + rng.integers(0, 256, rng.integers(0, 60)).astype("u1").tobytes()
        for path in ("/t.d", "/t.a[:]", "/t.a[-1]", '/t.b[:]{s=="x"}.s.d', "/t.b[3].s"):
            try:
                values = found([message], type, root, path)
            except (BadMessage, BadPath):
                continue
            assert all(len(v) < 60 for v in values)


def test_nested_counts_do_not_overflow() -> None:
    part = "=" * 80 + "\nMSG: x/{}\n{}[100000000] v\n"
    text = "A[100000000] a\nfloat64 d\n" + part.format("A", "B") + part.format("B", "float64")
    type = parse_ros(text, "x/msg/M", ros1=False)
    with pytest.raises(BadPath, match=holding("type")):
        found([b"\0\1\0\0" + bytes(100)], type, lambda b, s, e: cdr_messages(b, type, s, e), "/t.d")


IDL = """
// generated from rosidl
#include "geometry_msgs/msg/Vector3.idl"
module robot { module msg {
  const unsigned long SIZE = 3;
  typedef double triple[SIZE];
  enum Gear { REVERSE, NEUTRAL, FORWARD };
  module State_Constants { const string<9> NAME = "a;b"; };
  struct Empty { uint8 structure_needs_at_least_one_member; };
  @verbatim (language="comment", text= "a (long) text" "in parts")
  struct State {
    long first;
    @key @unit(value="m/s")
    double speed;
    octet flags, more[4];
    Gear gear;
    Empty none;
    unsigned long long count; long long offset; unsigned short u; short s;
    string<22> name;
    sequence<Vector3> points;
    triple row;
    boolean ok; /* the
    last */
  };
}; };
================================================================================
IDL: robot/msg/Vector3
module robot { module msg { struct Vector3 { double x; double y; float z; }; }; };
"""


def test_idl_definitions_are_the_same_types_as_ros_ones() -> None:
    typesys = pytest.importorskip("rosbags.typesys")
    texts = {
        "x/msg/T0": "int32 first\nfloat64 speed\nuint8 flags\nuint8[4] more\nuint32 gear\n"
        "E none\nuint64 count\nint64 offset\nuint16 u\nint16 s\nstring name\nV[] points\n"
        "float64[3] row\nbool ok\n",
        "x/msg/E": "",
        "x/msg/V": "float64 x\nfloat64 y\nfloat32 z\n",
    }
    store = typesys.get_typestore(typesys.Stores.EMPTY)
    types = {}
    for name, text in texts.items():
        types.update(typesys.get_types_from_msg(text, name))
    store.register(types)
    ros = parse_ros(concatenated(texts), "x/msg/T0", ros1=False)
    rng = random.Random(0)
    make = lambda n, f: store.types[n.replace("x/", "x/msg/")](**f)  # noqa: E731
    objects = [random_value(ros, rng, make) for _ in range(20)]
    messages = [bytes(store.serialize_cdr(o, "x/msg/T0")) for o in objects]
    idl = parse_idl(IDL, "robot/msg/State")
    for path in (
        "first",
        "speed",
        "gear",
        "count",
        "offset",
        "u",
        "s",
        "ok",
        "points[:].z",
        "row[2]",
    ):
        wanted = found(messages, ros, partial(decode, cdr_messages, ros), f"/t.{path}")
        mine = found(messages, idl, partial(decode, cdr_messages, idl), f"/t.{path}")
        assert mine == wanted and any(wanted), path


def test_idl_definitions_that_can_not_be_read() -> None:
    for bad, says in (
        ("module a { union U switch(long) { case 1: long x; }; };", "union"),
        ("struct M { Missing a; };", "Missing"),
        ("struct M { M a; };", "nested"),
        ("struct M { sequence<sequence<double>> a; };", "sequence"),
        ("struct M : B { double a; };", "struct M"),
        ("struct M { double a[2][2]; };", r"\]\["),
        ("struct M { @optional double a; };", "@optional"),
        ("struct M { double a[999999999]; };", "999999999"),
        ("struct M { long double a; };", "long"),
        ("struct N { long a; };", "M"),
        ("struct M {", "damaged"),
        ("what", "what"),
    ):
        with pytest.raises(BadSchema, match=says):
            parse_idl(bad, "M")


@pytest.mark.parametrize("seed", range(50))
def test_any_damaged_idl_is_told(seed: int) -> None:
    rng = random.Random(seed)
    text = list(IDL)
    for _ in range(rng.randint(1, 5)):
        at = rng.randrange(len(text))
        text[at : at + rng.randint(0, 20)] = rng.choice(["", "{", "}", ";", "@a(", '"', "[", "<"])
    try:
        parse_idl("".join(text), "robot/msg/State")
    except BadSchema as error:
        assert str(error)


def test_ros_definitions_that_are_none() -> None:
    for text, says in (
        ("Missing a", "Missing"),
        ("what is this?", "what"),
        ("???", "unexpected"),
        ("A a\n" + "=" * 80 + "\nMSG: x/A\nA a", "nested"),
        ("float64[999999999] a", "999999999"),
        (f"float64[{'9' * 5000}] a", "99999"),
        ("int8 a\n" + "=" * 80 + "\nIDL: x/A\n", "IDL"),
    ):
        with pytest.raises(BadSchema, match=says):
            parse_ros(text, "x/msg/M", ros1=False)


PROTO = {
    "double": ("TYPE_DOUBLE", "f8"),
    "float": ("TYPE_FLOAT", "f4"),
    "int32": ("TYPE_INT32", "i4"),
    "int64": ("TYPE_INT64", "i8"),
    "uint32": ("TYPE_UINT32", "u4"),
    "uint64": ("TYPE_UINT64", "u8"),
    "sint32": ("TYPE_SINT32", "i4"),
    "sint64": ("TYPE_SINT64", "i8"),
    "fixed32": ("TYPE_FIXED32", "u4"),
    "fixed64": ("TYPE_FIXED64", "u8"),
    "sfixed32": ("TYPE_SFIXED32", "i4"),
    "sfixed64": ("TYPE_SFIXED64", "i8"),
    "bool": ("TYPE_BOOL", "b1"),
}


def random_proto(rng: random.Random, seed: int) -> tuple[bytes, Any]:
    """A FileDescriptorSet with message 'p.T0', and the class of that message."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    kinds = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name=f"p{seed}.proto", package="p", syntax="proto3")
    count = rng.randint(1, 4)
    for i in range(count):
        message = file.message_type.add(name=f"T{i}")
        for j in range(rng.randint(1, 6)):
            number = rng.choice([j + 1, j + 100, j + 5000])
            label = rng.choice([kinds.LABEL_OPTIONAL, kinds.LABEL_OPTIONAL, kinds.LABEL_REPEATED])
            kind = rng.choice([*PROTO, "string", *["message"] * 4])
            field = message.field.add(name=f"f{j}", number=number, label=label)
            if kind == "message" and i + 1 < count:
                field.type, field.type_name = (
                    kinds.TYPE_MESSAGE,
                    f".p.T{rng.randint(i + 1, count - 1)}",
                )
            elif kind in ("message", "string"):
                field.type = kinds.TYPE_STRING
            else:
                field.type = getattr(kinds, PROTO[kind][0])
                if label == kinds.LABEL_REPEATED and rng.random() < 0.3:
                    field.options.packed = False
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    classes = message_factory.GetMessageClass(pool.FindMessageTypeByName("p.T0"))
    return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString(), classes


def fill(message: Any, type: Struct, rng: random.Random) -> Any:
    """Sets random fields; returns what a reader must find: absent messages are absent."""
    value: dict[str, Any] = {}
    for field in type.fields:
        inner = field.type
        if isinstance(inner, Array):
            items = []
            for _ in range(rng.randint(0, 3)):
                if isinstance(inner.item, Struct):
                    items.append(fill(getattr(message, field.name).add(), inner.item, rng))
                else:
                    items.append(random_value(inner.item, rng, lambda n, f: None))
            value[field.name] = items
            if not isinstance(inner.item, Struct):
                getattr(message, field.name).extend(items)
        elif isinstance(inner, Struct):
            if rng.random() < 0.7:
                part = getattr(message, field.name)
                part.SetInParent()
                value[field.name] = fill(part, inner, rng)
        else:
            value[field.name] = random_value(inner, rng, lambda n, f: None)
            setattr(message, field.name, value[field.name])
    return value


@pytest.mark.parametrize("seed", range(150))
def test_random_protobuf_messages(seed: int) -> None:
    rng = random.Random(seed)
    descriptor, make = random_proto(rng, seed)
    type = parse_protobuf(descriptor, "p.T0")
    objects, messages = [], []
    for _ in range(6):
        message = make()
        objects.append(fill(message, type, rng))
        messages.append(message.SerializeToString())
    for text in paths_of(type, rng):
        mine = found(messages, type, lambda b, s, e: protobuf_messages(b, type, s, e), "/t" + text)
        assert mine == [follow(o, parse_path("/t" + text)) for o in objects], text


def test_protobuf_from_an_older_or_other_writer() -> None:
    """Fields twice (the last counts), unknown ones, packed where not expected, and extremes."""
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet

    files = FileDescriptorSet()
    message = files.file.add(name="a", package="p").message_type.add(name="M")
    kinds = {"a": "INT32", "b": "SINT64", "c": "UINT64", "d": "DOUBLE"}
    for number, (name, kind) in enumerate(kinds.items(), start=1):
        kind_number = getattr(FieldDescriptorProto, f"TYPE_{kind}")
        message.field.add(name=name, number=number, type=kind_number, label=1)
    message.field[3].default_value = "2.5"
    type = parse_protobuf(files.SerializeToString(), "p.M")
    root = lambda b, s, e: protobuf_messages(b, type, s, e)  # noqa: E731
    negative = bytes([8, 0xFB, *[0xFF] * 8, 1])  # int32 -5 takes ten bytes
    twice = bytes([8, 1, 8, 2])
    unknown = bytes([0x7A, 3, 1, 2, 3, 8, 7])
    assert found([negative, twice, unknown, b""], type, root, "/t.a") == [[-5], [2], [7], [0]]
    assert found([b"\x10\x03"], type, root, "/t.b") == [[-2]]
    largest = bytes([0x18, *[0xFF] * 9, 1])
    assert found([largest], type, root, "/t.c") == [[float(2**64 - 1)]]
    assert found([b""], type, root, "/t.d") == [[2.5]]
    for bad in (b"\x08", b"\x08" + b"\xff" * 11, b"\x0a\x7f", b"\x21\0", b"\x0b"):
        with pytest.raises(BadMessage):
            found([b"", bad], type, root, "/t.a")
    rng = np.random.default_rng(0)
    for _ in range(500):
        noise = rng.integers(0, 256, rng.integers(0, 40)).astype("u1").tobytes()
        for path in ("/t.a", "/t.d"):
            try:
                assert len(found([noise], type, root, path)[0]) <= 1
            except BadMessage:
                continue


def test_a_protobuf_map_is_a_list_of_entries() -> None:
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.struct_pb2 import DESCRIPTOR, Struct

    files = FileDescriptorSet()
    DESCRIPTOR.CopyToProto(files.file.add())
    type = parse_protobuf(files.SerializeToString(), "google.protobuf.Struct")
    message = Struct()
    message.update({"speed": 1.5})
    root = lambda b, s, e: protobuf_messages(b, type, s, e)  # noqa: E731
    path = '/t.fields[:]{key=="speed"}.value.number_value'
    assert found([message.SerializeToString(), b""], type, root, path) == [[1.5], []]


def test_protobuf_definitions_that_are_none() -> None:
    from google.protobuf import descriptor_pb2

    rng = np.random.default_rng(1)
    good, _ = random_proto(random.Random(3), 3)
    with pytest.raises(BadSchema, match=holding("p.Nothing")):
        parse_protobuf(good, "p.Nothing")
    for number, code in ((0, 1), (2**29, 1), (1, 10)):
        file = descriptor_pb2.FileDescriptorProto(name="a")
        file.message_type.add(name="M").field.add(name="f", number=number, type=code, label=1)
        with pytest.raises(BadSchema, match="'f'"):
            parse_protobuf(descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString(), "M")
    for _ in range(500):
        bad = bytearray(good)
        for _ in range(3):
            bad[rng.integers(len(bad))] = rng.integers(256)
        try:
            parse_protobuf(bytes(bad), "p.T0")
        except BadSchema:
            continue


def test_json() -> None:
    objects = [
        {"a": 1, "b": {"c": [1.5, 2, None]}, "l": [{"n": "x", "v": 3}, {"n": "y", "v": 4}]},
        {"a": True, "b": {"c": []}, "l": []},
        {"b": {}},
    ]
    messages = [json.dumps(o).encode() for o in objects]
    for text in ("/t.a", "/t.b.c[0]", "/t.b.c[-2]", '/t.l[:]{n=="y"}.v', "/t.l[:]{v>3}.v"):
        mine = found(messages, Dynamic(), json_messages, text)
        assert mine == [follow(o, parse_path(text)) for o in objects], text
    ((value,), *_) = found(messages, Dynamic(), json_messages, "/t.b.c[2]")
    assert np.isnan(value)
    assert found([b'{"v": {"x": 3, "y": 4}}'], Dynamic(), json_messages, "/t.v.@norm") == [[5]]
    assert found([b'{"v": [3, 4]}'], Dynamic(), json_messages, "/t.v.@norm") == [[5]]
    assert found([b'{"v": 1' + b"0" * 400 + b"}"], Dynamic(), json_messages, "/t.v") == [[np.inf]]
    with pytest.raises(BadMessage, match=holding("JSON")):
        found([b"{}", b"{"], Dynamic(), json_messages, "/t.a")
    with pytest.raises(BadMessage, match=holding("JSON")):
        found([b"[" * 100_000], Dynamic(), json_messages, "/t.a")
    with pytest.raises(BadPath, match=holding("str", "message 0")):
        found([b'{"a": "1"}'], Dynamic(), json_messages, "/t.a")


def test_quaternions_and_vectors() -> None:
    text = (
        "Q q\nfloat64[2] l\n" + "=" * 80 + "\nMSG: x/Q\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w"
    )
    type = parse_ros(text, "x/msg/M", ros1=False)
    rng = np.random.default_rng(0)
    numbers = rng.normal(size=(50, 6))
    numbers[0, :4] = 0
    messages = [b"\0\1\0\0" + row.tobytes() for row in numbers]
    root = lambda b, s, e: cdr_messages(b, type, s, e)  # noqa: E731
    objects = [{"q": dict(zip("xyzw", row[:4], strict=True)), "l": row[4:]} for row in numbers]
    for path in ("/t.q.@rpy.roll", "/t.q.@rpy.pitch", "/t.q.@rpy.yaw", "/t.q.@rpy.yaw.@mul(2)"):
        mine = np.ravel(found(messages, type, root, path))
        assert np.isnan(mine[0])
        wanted = [follow(o, parse_path(path))[0] for o in objects[1:]]
        np.testing.assert_allclose(mine[1:], wanted, atol=1e-12)
    lengths = np.ravel(found(messages, type, root, "/t.l.@norm"))
    np.testing.assert_allclose(lengths, np.hypot(*numbers[:, 4:].T))


def test_paths_that_do_not_fit_name_what_would() -> None:
    text = "float64 speed\nstring name\nQ[] list\nQ q\n" + "=" * 80 + "\nMSG: x/Q\nfloat64 x\n"
    type = parse_ros(text, "x/msg/M", ros1=False)
    for path, says in (
        ("/t.sped", "did you mean 'speed'"),
        ("/t.name", "found string"),
        ("/t", "speed, name, list and q"),
        ("/t.list", "expected number"),
        ("/t.list.x", "expected .0."),
        ("/t.speed.x", "expected message"),
        ("/t.q[0]", "expected list"),
        ("/t.q.@rpy.yaw", "expected x, y, z, w"),
        ("/t.speed.@norm", "expected numbers"),
        ('/t.list[:]{x=="a"}.x', "expected str at x"),
        ("/t{name==1}.speed", "expected float at name"),
    ):
        with pytest.raises(BadPath, match=says):
            bind(parse_path(path), type)
