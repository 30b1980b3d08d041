"""Message paths and columns: what is one, what is not, and that no text brings down the parser."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from grounded.errors import GroundedError
from grounded_trials.formats.message_path import (
    FUNCTIONS,
    Field,
    Filter,
    MessagePath,
    Slice,
    parse_path,
)
from grounded_trials.formats.tables import npz_tables
from grounded_trials.formats.text_tables import csv_tables


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
