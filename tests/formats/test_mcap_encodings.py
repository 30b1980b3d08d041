"""Message paths, and CDR, ROS 1, protobuf and JSON: what is in messages is found."""

from __future__ import annotations

import json
import random
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from facts import holding
from grounded.errors import GroundedError
from grounded_trials.formats.bad import BadMessage, BadPath, BadSchema
from grounded_trials.formats.mcap_records import Channel, Messages, Schema
from grounded_trials.formats.message_path import (
    FUNCTIONS,
    Field,
    Filter,
    MessagePath,
    Slice,
    parse_path,
)
from grounded_trials.formats.messages import decoder_of
from grounded_trials.formats.path_walk import evaluate
from grounded_trials.formats.tables import npz_tables
from grounded_trials.formats.text_tables import csv_tables

LINE = "=" * 80 + "\n"


def batch(messages: list[bytes]) -> Messages:
    """Messages in one buffer, at odd places."""
    buffer, starts, ends = b"\xff" * 3, [], []
    for message in messages:
        starts.append(len(buffer))
        buffer += message
        ends.append(len(buffer))
        buffer += b"\xee" * 5
    t = np.arange(len(messages))
    return Messages(buffer, np.array(starts), np.array(ends), 0 * t.astype("u2"), t, t, t)


def found(
    messages: list[bytes], encoding: str, path: str, text: str | bytes = "", name: str = "x/msg/M"
) -> list[list[float]]:
    """The numbers at a path in each message."""
    kinds = {"cdr": "ros2msg", "idl": "ros2idl", "ros1": "ros1msg"}
    data = text.encode() if isinstance(text, str) else text
    schema = Schema(1, name, kinds.get(encoding, encoding), data)
    encoding = "cdr" if encoding == "idl" else encoding
    decoder = decoder_of(Channel(1, "/t", encoding, 1, {}), schema)
    lists: list[list[float]] = []
    for part in decoder.parts(batch(messages)):
        values = evaluate(part, parse_path(path), stamps=False)
        lists += [[] for _ in part.objects]
        for row, value in zip(values.rows.tolist(), values.values.tolist(), strict=True):
            lists[row - len(part.objects)].append(value)
    return lists


ROS = (
    "# a comment\r\nuint8 SIZE=3\nuint8 idle=0\nuint8 a\nfloat64 b\nstring c\nI[] list\nbyte d\n"
    "float32[2] e\nint64 g\n" + LINE + "MSG: x/I\nstring n\nint16 v 7\n"
)
IDL = (
    """
// generated from rosidl
#include "x/msg/I.idl"
module x { module msg {
  const unsigned long SIZE = 3;
  enum Gear { REVERSE, NEUTRAL, FORWARD };
  struct M { uint8 a; @unit(value="m/s") double b; string<22> c; sequence<I> list; octet d;
    float e[2]; long long g; };
}; };
"""
    + LINE
    + """IDL: x/msg/I
module x { module msg { struct I { string n; short v; }; }; };
"""
)


def cdr(order: str) -> bytes:
    text = struct.pack(f"{order}B7xdI4sI", 1, 2.5, 4, b"abc\0", 2)
    text += struct.pack(f"{order}I2shI2shB3x2fq", 2, b"p\0", 3, 2, b"q\0", -4, 200, 0.5, -1.5, -7)
    return (b"\0\1\0\0" if order == "<" else b"\0\0\0\0") + text


ROS1 = struct.pack("<BdI3s", 1, 2.5, 3, b"abc")
ROS1 += struct.pack("<II1shI1shb2fq", 2, 1, b"p", 3, 1, b"q", -4, 100, 0.5, -1.5, -7)
WANTED = {
    "/t.a": [1],
    '/t{c=="abc"}.b': [2.5],
    '/t{c!="abc"}.b': [],
    "/t{a>1}.b": [],
    "/t.list[:].v": [3, -4],
    "/t.list[-1].v": [-4],
    '/t.list[:]{n=="p"}.v': [3],
    "/t.list[2].v": [],
    "/t.e[1]": [-1.5],
    "/t.e.@norm": [np.sqrt(2.5)],
    "/t.g": [-7],
}


@pytest.mark.parametrize("path", WANTED)
def test_ros_messages(path: str) -> None:
    for encoding, text, message in (
        ("cdr", ROS, cdr("<")),
        ("cdr", ROS, cdr(">")),
        ("idl", IDL, cdr("<")),
        ("ros1", ROS, ROS1),
    ):
        assert found([message, message], encoding, path, text) == [WANTED[path]] * 2, encoding


def test_other_variants_of_cdr_and_short_messages_are_refused() -> None:
    for bad in (b"\0\7\0\0" + cdr("<")[4:], b"\0\1", b"", cdr("<")[:-3], cdr("<") + bytes(8)):
        with pytest.raises(BadMessage) as odd:
            found([cdr("<"), bad], "cdr", "/t.a", ROS)
        assert odd.value.message == 1
    rng = np.random.default_rng(0)
    for _ in range(100):
        noise = rng.integers(0, 256, rng.integers(0, 60)).astype("u1").tobytes()
        for encoding, head in (("cdr", b"\0\1\0\0"), ("ros1", b"")):
            try:
                assert len(found([head + noise], encoding, "/t.list[:].v", ROS)[0]) < 60
            except BadMessage:
                continue


def test_definitions_that_can_not_be_read() -> None:
    for encoding, bad in (
        ("idl", "module a { union U switch(long) { case 1: long x; }; };"),
        ("idl", "struct M { Missing a; };"),
        ("idl", "struct M { sequence<sequence<double>> a; };"),
        ("idl", "struct M : B { double a; };"),
        ("idl", "struct M { @optional double a; };"),
        ("idl", "struct M {"),
        ("cdr", "Missing a"),
        ("cdr", "what is this?"),
        ("cdr", "A a\n" + LINE + "MSG: x/A\nA a"),
        ("protobuf", b"\x0a\xff"),
        ("flatbuffer", ""),
    ):
        with pytest.raises(BadSchema):
            found([], encoding, "/t.a", bad)
    rng = random.Random(0)
    for _ in range(50):
        text = list(IDL)
        for _ in range(rng.randint(1, 5)):
            at = rng.randrange(len(text))
            text[at : at + rng.randint(0, 20)] = rng.choice(["", "{", "}", ";", "@a(", '"', "["])
        try:
            found([], "idl", "/t.a", "".join(text))
        except BadSchema as error:
            assert error.finding.code == "file.decode"


def test_protobuf() -> None:
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet

    files = FileDescriptorSet()
    types = files.file.add(name="a", package="p", syntax="proto2").message_type
    message, inner = types.add(name="M"), types.add(name="I")
    inner.field.add(name="v", number=1, type=FieldDescriptorProto.TYPE_SINT64, label=1)
    for number, (name, kind, label) in enumerate(
        (("ä", "INT32", 1), ("d", "DOUBLE", 1), ("l", "FLOAT", 3), ("i", "MESSAGE", 1)), start=1
    ):
        kind_number = getattr(FieldDescriptorProto, f"TYPE_{kind}")
        message.field.add(name=name, number=number, type=kind_number, label=label)
    message.field[1].default_value = "2.5"
    message.field[3].type_name = ".p.I"
    text = files.SerializeToString()

    def numbers(path: str, *messages: bytes) -> list[list[float]]:
        return found([*messages], "protobuf", path, text, "p.M")

    negative = bytes([8, 0xFB, *[0xFF] * 8, 1])  # int32 -5 takes ten bytes
    unknown = bytes([0x7A, 3, 1, 2, 3, 8, 7])
    assert numbers('/t."ä"', negative, b"\x08\1\x08\2", unknown, b"") == [[-5], [2], [7], [0]]
    assert numbers("/t.d", b"") == [[2.5]]
    floats = struct.pack("<BBff", 0x1A, 8, 1.5, -2.0)
    assert numbers("/t.l[:]", floats, b"") == [[1.5, -2.0], []]
    assert numbers("/t.i.v", b"", b"\x22\2\x08\3") == [[], [-2]]  # an absent message has no row
    for bad in (b"\x08", b"\x08" + b"\xff" * 11, b"\x0a\x7f", b"\x11\0", b"\x0b"):
        with pytest.raises(BadMessage):
            numbers('/t."ä"', b"", bad)
    with pytest.raises(BadPath, match=holding("p.M", "dd")):
        numbers("/t.dd", b"")
    with pytest.raises(BadSchema, match=holding("p.Nothing")):
        found([], "protobuf", "/t.d", text, "p.Nothing")


def test_a_protobuf_map_is_a_list_of_entries() -> None:
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.struct_pb2 import DESCRIPTOR, Struct

    files = FileDescriptorSet()
    DESCRIPTOR.CopyToProto(files.file.add())
    message = Struct()
    message.update({"speed": 1.5})
    path, texts = '/t.fields[:]{key=="speed"}.value.number_value', files.SerializeToString()
    messages = [message.SerializeToString(), b""]
    assert found(messages, "protobuf", path, texts, "google.protobuf.Struct") == [[1.5], []]


def test_json() -> None:
    objects: list[dict[str, Any]] = [
        {"a": 1, "b": {"c": [1.5, 2, None]}, "l": [{"n": "x", "v": 3}, {"n": "y", "v": 4}]},
        {"a": True, "b": {"c": []}, "l": []},
        {"b": {}},
    ]
    messages = [json.dumps(o).encode() for o in objects]
    wanted = {
        "/t.a": [[1.0], [1.0], []],
        "/t.b.c[0]": [[1.5], [], []],
        "/t.b.c[-2]": [[2.0], [], []],
        '/t.l[:]{n=="y"}.v': [[4.0], [], []],
        "/t.l[:]{v>3}.v": [[4.0], [], []],
    }
    assert {text: found(messages, "json", text) for text in wanted} == wanted
    ((value,), *_) = found(messages, "json", "/t.b.c[2]")
    assert np.isnan(value)
    assert found([b'{"v": {"x": 3, "y": 4}}'], "json", "/t.v.@norm") == [[5]]
    assert found([b'{"v": [3, 4]}'], "json", "/t.v.@norm") == [[5]]
    assert found([b'{"v": 1' + b"0" * 400 + b"}"], "json", "/t.v") == [[np.inf]]
    for bad in (b"{", b"[" * 100_000):
        with pytest.raises(BadMessage, match=holding("message")):
            found([b"{}", bad], "json", "/t.a")
    with pytest.raises(BadPath, match=holding("str")):
        found([b'{"a": "1"}'], "json", "/t.a")


def test_quaternions_and_vectors() -> None:
    text = "Q q\nfloat64[2] l\n" + LINE + "MSG: x/Q\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
    rng = np.random.default_rng(0)
    numbers = rng.normal(size=(50, 6))
    numbers[0, :4] = 0
    messages = [b"\0\1\0\0" + row.tobytes() for row in numbers]
    angles = Rotation.from_quat(numbers[1:, :4]).as_euler("ZYX").T
    for name, wanted in zip(("yaw", "pitch", "roll"), angles, strict=True):
        mine = np.ravel(found(messages, "cdr", f"/t.q.@rpy.{name}", text))
        assert np.isnan(mine[0])
        np.testing.assert_allclose(mine[1:], wanted, atol=1e-9)
    lengths = np.ravel(found(messages, "cdr", "/t.l.@norm", text))
    np.testing.assert_allclose(lengths, np.hypot(*numbers[:, 4:].T))


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("/t.sped", "did you mean 'speed'"),
        ("/t.name", "found str"),
        ("/t", "speed, name, list and q"),
        ("/t.list", "expected number"),
        ("/t.list.x", "expected .0."),
        ("/t.speed.x", "expected message"),
        ("/t.q[0]", "expected list"),
        ("/t.q.@rpy.yaw", "expected x, y, z, w"),
        ("/t.speed.@norm", "expected numbers"),
        ('/t.list[:]{x=="a"}.x', "expected str at x"),
        ("/t{name==1}.speed", "expected float at name"),
    ],
)
def test_paths_that_do_not_fit_name_what_would(path: str, says: str) -> None:
    text = "float64 speed\nstring name\nQ[] list\nQ q\n" + LINE + "MSG: x/Q\nfloat64 x\n"
    message = b"\0\1\0\0" + struct.pack("<dI1s3xI4xdd", 1, 1, b"\0", 1, 2, 3)
    with pytest.raises(BadPath, match=says):
        found([message], "cdr", path, text)


@pytest.mark.parametrize(
    ("value", "path"),
    [
        ({"l": [{"a": {}, "v": 1}]}, "/t.l[:]{a>1}.v"),
        ({"q": {"x": "a", "y": 0, "z": 0, "w": 1}}, "/t.q.@rpy.yaw"),
        ({"q": ["a", 0, 0, 1]}, "/t.q.@rpy.yaw"),
    ],
)
def test_what_is_no_number_is_refused_wherever_a_path_needs_one(value: Any, path: str) -> None:
    with pytest.raises(BadPath):
        found([json.dumps(value).encode()], "json", path)


@pytest.mark.parametrize("path", ["/t.q.@rpy.yaw", "/t.v.@norm"])
def test_one_null_among_messages_is_a_missing_sample(path: str) -> None:
    whole = {"q": {"x": 0, "y": 0, "z": 0, "w": 1}, "v": [3, 4]}
    messages = [json.dumps(one).encode() for one in (whole, {"q": None, "v": None})]
    first, second = np.ravel(found(messages, "json", path))
    assert first == (5.0 if "norm" in path else 0.0) and np.isnan(second)


@pytest.mark.parametrize(
    ("text", "topic", "steps", "function"),
    [
        ("/a.b", "/a", [Field("b")], ""),
        ("/a/b_1", "/a/b_1", [], ""),
        ("topic1.x", "topic1", [Field("x")], ""),
        ('"/odd topic.name".x', "/odd topic.name", [Field("x")], ""),
        ("'/a'.\"b c\"", "/a", [Field("b c")], ""),
        ("/a.b[2].c", "/a", [Field("b"), Slice(2, 2), Field("c")], ""),
        ("/a.b[-1]", "/a", [Field("b"), Slice(-1, -1)], ""),
        ("/a.b[1:3]", "/a", [Field("b"), Slice(1, 3)], ""),
        ("/a.b[:]", "/a", [Field("b"), Slice(0, -1)], ""),
        ("/a.b[:-2]", "/a", [Field("b"), Slice(0, -2)], ""),
        ("/a.b[-2:]", "/a", [Field("b"), Slice(-2, -1)], ""),
        ('/a{n=="b"}.x', "/a", [Filter(("n",), "==", "b"), Field("x")], ""),
        ("/a{n.m >= -1.5e3}.x", "/a", [Filter(("n", "m"), ">=", -1500.0), Field("x")], ""),
        ("/a{n==true}.x", "/a", [Filter(("n",), "==", 1.0), Field("x")], ""),
        ("/a{n<1&&m!=2}", "/a", [Filter(("n",), "<", 1.0), Filter(("m",), "!=", 2.0)], ""),
        ("/a{n<1}{m!=2}", "/a", [Filter(("n",), "<", 1.0), Filter(("m",), "!=", 2.0)], ""),
        ("/a.q.@rpy.yaw", "/a", [Field("q")], "rpy.yaw"),
        ("/a.v.@norm", "/a", [Field("v")], "norm"),
    ],
)
def test_paths(text: str, topic: str, steps: list[object], function: str) -> None:
    assert parse_path(text) == MessagePath(text, topic, tuple(steps), function)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("text", "at"),  # the character from 1; 0: the end
    [
        *(("", 0), ("/a.", 3), ("/a..b", 3), ("/a[", 3), ("/a[]", 3), ("/a[1", 3), ("/a[1:2", 3)),
        *(("/a[$i]", 3), ("/a[99999999999]", 3), ("/a{}", 4), ("/a{x=1}", 4), ("/a{x=='}", 3)),
        *(('/a{x<"b"}', 4), ("/a{x==1", 3), ("/a{x==1&&}", 10), ("/a.@yaw", 3), ("/a.@rpy", 3)),
        *(("/a.@rpy.jaw", 3), ("/a.@norn", 3), ("/a.x.@derivative", 5), ("/a.x.@delta", 5)),
        *(
            ("/a.x.@norm.y", 5),
            ("/a.@norm.@norm", 3),
            ("/a b", 3),
            (".x", 1),
            ("/" + "a" * 2000, 1001),
        ),
    ],
)
def test_no_paths(text: str, at: int) -> None:
    with pytest.raises(GroundedError) as refusal:
        parse_path(text)
    finding = refusal.value.finding
    assert finding is not None and finding.code == "file.path" and finding.facts["at"] == str(at)


@pytest.mark.parametrize(
    ("text", "says"),
    [("/a.@rpy", "@rpy.roll"), ("/a.@norn", "@norm"), ("/a.x.@delta", "not '@delta'")],
)
def test_what_can_be_written_instead_is_said(text: str, says: str) -> None:
    with pytest.raises(GroundedError, match=says):
        parse_path(text)


PIECES = ["/a", ".", ".x", "[", "]", ":", "1", "-", "{", "}", "==", "<", '"', "'", "&&", "@", ".@"]
PIECES += ["rpy", ".yaw", "(", ")", "$", "1e9", "true", " ", "é", "\x00", "norm", "mul"]


@given(st.lists(st.sampled_from(PIECES), max_size=12).map("".join) | st.text(max_size=40))
def test_any_text_parses_or_says_why(text: str) -> None:
    try:
        path = parse_path(text)
    except GroundedError as error:
        assert str(error)
    else:
        assert path.topic and path.text == text


NAMES = st.from_regex(r"[a-z_][a-z0-9_]{0,8}", fullmatch=True)
INDEX = st.integers(-99, 99)
VALUES = st.integers(-99, 99).map(float) | st.text("abc xyz", min_size=1, max_size=5)
STEPS = st.one_of(
    st.builds(Field, NAMES),
    st.builds(Slice, INDEX, INDEX),
    st.builds(
        lambda n, v, o: Filter(tuple(n), o if isinstance(v, float) else "==", v),
        st.lists(NAMES, min_size=1, max_size=3),
        VALUES,
        st.sampled_from(["==", "!=", "<", "<=", ">", ">="]),
    ),
)


def spell(path: MessagePath) -> str:
    text = path.topic
    for step in path.steps:
        if isinstance(step, Field):
            text += f".{step.name}"
        elif isinstance(step, Slice):
            text += f"[{step.start}]" if step.is_index else f"[{step.start}:{step.stop}]"
        else:
            value = f'"{step.value}"' if isinstance(step.value, str) else f"{step.value:g}"
            text += f"{{{'.'.join(step.path)} {step.operator} {value}}}"
    return text + f".@{path.function}" * bool(path.function)


@given(NAMES, st.lists(STEPS, max_size=6), st.sampled_from(["", *FUNCTIONS]))
def test_what_is_spelled_is_parsed(name: str, steps: list[object], function: str) -> None:
    path = MessagePath("", f"/{name}", tuple(steps), function)  # type: ignore[arg-type]
    found = parse_path(spell(path))
    assert (found.topic, found.steps, found.function) == (path.topic, path.steps, path.function)


@pytest.mark.parametrize(
    "head", ["t,theta,omega,torque,theta", "t,theta [rad],omega,torque,theta [deg]"]
)
def test_a_column_that_stands_twice_in_a_text_table_is_refused(tmp_path, head):
    path = tmp_path / "log.csv"
    rows = "\n".join(f"{0.1 * k:.1f},{k},1,2,{-k}" for k in range(20))
    path.write_text(f"{head}\n{rows}\n")
    with pytest.raises(GroundedError, match="theta"):
        list(csv_tables(path))
    path.write_text(f"t,theta,omega,torque,other\n{rows}\n")
    assert list(csv_tables(path))


def test_a_column_that_stands_twice_in_an_archive_is_refused(tmp_path):
    path, t = tmp_path / "log.npz", np.arange(5.0)
    np.savez(path, state=np.zeros((5, 2)), state_t=t, state_names=np.array(["x", "x"]))
    with pytest.raises(GroundedError, match="'x'"):
        list(npz_tables(path))
    np.savez(path, **{"t": t, "a b": t, "a_b": t})
    with pytest.raises(GroundedError, match="a_b"):
        list(npz_tables(path))
