"""Parse message paths in Foxglove's syntax, which select a number in a topic's messages.

    /odom.pose.pose.orientation.@rpy.yaw      a field, and a function of it at the end
    /motors.current[2]   .ranges[-1]          an item; negative counts from the end
    /tf.transforms[:]{child_frame_id=="car"}.transform.translation.x
                                              a slice (both ends included), a filter on its items
    "/odd topic.name".data                    names with dots or blanks in quotes

Functions: @rpy.roll|pitch|yaw of a quaternion (named x, y, z, w, or an array w, x, y, z as PX4's),
@world_velocity.x|y|z of an Odometry message, @norm of a vector or list. Filters compare with ==
!= < <= > >=; several may follow each other or be joined by &&. This module only parses;
`path_walk` applies a path to messages.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import NoReturn

from grounded.errors import GroundedError
from grounded.findings import found

ANGLES = ("roll", "pitch", "yaw")
AXES = ("x", "y", "z")
WORLD = "world_velocity"  # an Odometry's velocity, turned from the robot's axes into its pose's
LENGTH_LIMIT = 1000  # characters in a path

FUNCTIONS = ("norm", *(f"rpy.{one}" for one in ANGLES), *(f"{WORLD}.{one}" for one in AXES))


@dataclass(frozen=True)
class Field:
    """A step into a struct's field."""

    name: str


@dataclass(frozen=True)
class Slice:
    """An array's items from start to stop, both included; an index has start == stop."""

    start: int
    stop: int

    @property
    def is_index(self) -> bool:
        """Whether it selects one item."""
        return self.start == self.stop


@dataclass(frozen=True)
class Filter:
    """A condition: the field at `path` compares to `value` by `operator`."""

    path: tuple[str, ...]
    operator: str
    value: float | str


Step = Field | Slice | Filter


@dataclass(frozen=True)
class MessagePath:
    """A topic, the steps into its messages, and one of `FUNCTIONS` of the value there, or ""."""

    text: str
    topic: str
    steps: tuple[Step, ...]
    function: str = ""


_NAME = r"[A-Za-z0-9_\-]+"
_QUOTED = r"""'[^']+'|"[^"]+\""""
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_TOPIC = re.compile(r"[^\s.\[\]{}\"'@=<>!&]+")
_FIRST = re.compile(rf"{_QUOTED}|{_TOPIC.pattern}")
_STEP = re.compile(
    rf"""
    \.(?P<field>{_NAME}|{_QUOTED}) |
    \[(?P<start>-?\d{{1,9}})?(?P<range>:(?P<stop>-?\d{{1,9}})?)?\] |
    \{{(?P<filters>(?:[^{{}}'"]|'[^']*'|"[^"]*")*)\}}
    """,
    re.VERBOSE,
)
_CONDITION = re.compile(
    rf"""\s*(?P<path>{_NAME}(?:\.{_NAME})*)\s*(?P<operator>[=!<>]=|[<>])\s*
    (?:(?P<text>'[^']*'|"[^"]*")|(?P<value>true|false|{_NUMBER}))\s*(?:&&|$)""",
    re.VERBOSE,
)
_EXPECTED = {  # by the first character of what can't be read
    ".": "a field's name or '@function'",
    "[": "'[index]' or '[from:to]'",
    "{": "'{field == value}', == or != before a text",
}


def parse_path(text: str) -> MessagePath:
    """Parse a message path."""
    return _parsed(text) if isinstance(text, str) else _fail(str(text), 0, "/topic.field")


def is_name(text: str) -> bool:
    """Check whether a field's name needs no quotes."""
    return re.fullmatch(_NAME, text) is not None


def is_topic(text: str) -> bool:
    """Check whether a topic's name needs no quotes."""
    return _TOPIC.fullmatch(text) is not None


@lru_cache(maxsize=4096)
def _parsed(text: str) -> MessagePath:
    if len(text) > LENGTH_LIMIT:
        _fail(text, LENGTH_LIMIT, "its end")
    if (first := _FIRST.match(text)) is None:
        _fail(text, 0, "a topic" if text.strip() else "/topic.field")
    steps, function, at = list[Step](), "", first.end()
    while at < len(text):
        if text.startswith(".@", at):
            if (function := text[at + 2 :]) not in FUNCTIONS:
                _fail(text, at, f"{', '.join(f'@{one}' for one in FUNCTIONS)}, not '@{function}'")
            break
        if (seen := _STEP.match(text, at)) is None:
            _fail(text, at, _EXPECTED.get(text[at], "'.field', '[index]', '{filter}'"))
        elif seen["field"]:
            steps.append(Field(_bare(seen["field"])))
        elif seen["filters"] is not None:
            steps += _filters(text, at, seen["filters"])
        elif seen["range"] is None and seen["start"] is None:
            _fail(text, at, _EXPECTED["["])
        else:
            start = int(seen["start"] or 0)
            stop = start if seen["range"] is None else int(seen["stop"] or -1)
            steps.append(Slice(start, stop))
        at = seen.end()
    return MessagePath(text, _bare(first[0]), tuple(steps), function)


def _bare(name: str) -> str:
    return name[1:-1] if name[0] in "'\"" else name


def _filters(text: str, at: int, inside: str) -> list[Filter]:
    """Return the conditions between braces, joined by &&."""
    found, pos, goes_on = list[Filter](), 0, True
    while goes_on:
        seen = _CONDITION.match(inside, pos)
        if seen is None or (seen["text"] and seen["operator"] not in ("==", "!=")):
            _fail(text, at + 1 + pos, _EXPECTED["{"])
        truth = {"true": 1.0, "false": 0.0}
        value = truth[seen["value"]] if seen["value"] in truth else float(seen["value"] or 0.0)
        said = value if seen["text"] is None else seen["text"][1:-1]
        found.append(Filter(tuple(seen["path"].split(".")), seen["operator"], said))
        pos, goes_on = seen.end(), seen[0].endswith("&&")
    return found


def _fail(text: str, at: int, expected: str) -> NoReturn:
    place, shown = at + 1 if at < len(text) else 0, text[: LENGTH_LIMIT // 10]
    raise GroundedError(found("file.path", path=shown, at=str(place), expected=expected))
