"""Parse message paths in Foxglove's syntax, which select a number in a topic's messages.

    /odom.pose.pose.orientation.@rpy.yaw      a field, then a function of it
    /motors.current[2]   .ranges[-1]          an item; negative counts from the end
    /tf.transforms[:]{child_frame_id=="car"}.transform.translation.x
                                              a slice (both ends included), a filter on its items
    "/odd topic.name".data                    names with dots or blanks in quotes

Functions: @rpy.roll|pitch|yaw of a quaternion (named x, y, z, w, or an array w, x, y, z as PX4's),
@world_velocity.x|y|z of an Odometry message, @norm of a vector or list, and of a number: @abs
@negative @sign @sqrt @sin @cos @tan @asin @acos @atan @exp @log @ceil @floor @round @deg2rad
@rad2deg @add(c) @sub(c) @mul(c) @div(c). Filters compare with == != < <= > >=; several may follow
each other or be joined by &&. This module only parses; `path_walk` applies a path to messages.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache
from typing import NoReturn

from grounded.errors import GroundedError, alike
from grounded.findings import found

_TRIGONOMETRY = ("sin", "cos", "tan", "asin", "acos", "atan")
_ROUNDING = ("abs", "negative", "sign", "ceil", "floor", "round")
UNARY = (*_TRIGONOMETRY, *_ROUNDING, "sqrt", "exp", "log", "deg2rad", "rad2deg")
BINARY = ("add", "sub", "mul", "div")
ANGLES = ("roll", "pitch", "yaw")
AXES = ("x", "y", "z")
WORLD = "world_velocity"  # an Odometry's velocity, turned from the robot's axes into its pose's
LENGTH_LIMIT = 1000  # characters in a path

_INSTEAD = {  # of functions that can't be used: what can
    "delta": "a measured or estimated state",
    "derivative": "a measured or estimated state",
    "timedelta": "a signal",
    "quat": "a field of the orientation",
    "rpy": ".@rpy.roll, .@rpy.pitch or .@rpy.yaw",
    WORLD: f".@{WORLD}.x, .@{WORLD}.y or .@{WORLD}.z",
}
_PARTS = {"rpy": ANGLES, WORLD: AXES}  # functions that give several numbers, and their names


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


@dataclass(frozen=True)
class Function:
    """A function of the value found; `argument` is used by the arithmetic ones."""

    name: str
    argument: float = 0.0


Step = Field | Slice | Filter


@dataclass(frozen=True)
class MessagePath:
    """A topic, the steps into its messages, and functions of the value there."""

    text: str
    topic: str
    steps: tuple[Step, ...]
    functions: tuple[Function, ...] = ()


def parse_path(text: str) -> MessagePath:
    """Parse a message path.

    Raises:
        GroundedError: if it is invalid, stating the character.
    """
    return _parsed(text) if isinstance(text, str) else _Parser(text).path()


@lru_cache(maxsize=4096)
def _parsed(text: str) -> MessagePath:
    return _Parser(text).path()


_NAME = re.compile(r"[A-Za-z0-9_\-]+")
_TOPIC = re.compile(r"[^\s.\[\]{}\"'@=<>!&]+")
_INTEGER = re.compile(r"-?\d{1,9}(?!\d)")
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
_WORD = re.compile(r"[A-Za-z0-9_]+")
_OPERATOR = re.compile(r"==|!=|<=|>=|<|>")
_BLANK = re.compile(r"\s*")


def is_name(text: str) -> bool:
    """Check whether a field's name needs no quotes."""
    return _NAME.fullmatch(text) is not None


def is_topic(text: str) -> bool:
    """Check whether a topic's name needs no quotes."""
    return _TOPIC.fullmatch(text) is not None


class _Parser:
    def __init__(self, text: str) -> None:
        self.text, self.pos = text, 0

    def path(self) -> MessagePath:
        if not isinstance(self.text, str) or not self.text.strip():
            self.fail("/topic.field")
        if len(self.text) > LENGTH_LIMIT:
            self.pos = LENGTH_LIMIT
            self.fail("its end")
        topic = self.name(_TOPIC, "a topic")
        steps: list[Step] = []
        functions: list[Function] = []
        while self.pos < len(self.text):
            if self.text.startswith(".@", self.pos):
                functions.append(self.function())
            elif functions:
                self.fail("a function or the end")
            else:
                steps.extend(self.step())
        return MessagePath(self.text, topic, tuple(steps), tuple(functions))

    def step(self) -> list[Step]:
        mark = self.peek()
        if mark == ".":
            self.pos += 1
            return [Field(self.name(_NAME, "a field's name"))]
        if mark == "[":
            return [self.slice()]
        if mark == "{":
            return list(self.filters())
        self.fail("'.field', '[index]', '{filter}' or '.@function'")

    def slice(self) -> Slice:
        self.pos += 1
        start = self.integer()
        if self.take("]"):
            if start is None:
                self.fail("an index or ':'")
            return Slice(start, start)
        self.expect(":", "':' or ']'")
        stop = self.integer()
        self.expect("]")
        return Slice(0 if start is None else start, -1 if stop is None else stop)

    def integer(self) -> int | None:
        if self.peek() == "$":
            self.fail("a number")
        seen = _INTEGER.match(self.text, self.pos)
        if not seen:
            return None
        self.pos = seen.end()
        return int(seen[0])

    def filters(self) -> list[Filter]:
        self.pos += 1
        seen = [self.filter()]
        while self.take("&&"):
            seen.append(self.filter())
        self.expect("}")
        return seen

    def filter(self) -> Filter:
        self.blank()
        names = [self.match(_NAME, "a field's name")]
        while self.take("."):
            names.append(self.match(_NAME, "a field's name"))
        self.blank()
        operator = self.match(_OPERATOR, "== != < <= > or >=")
        self.blank()
        value = self.value()
        self.blank()
        if isinstance(value, str) and operator not in ("==", "!="):
            self.fail("== or != before a text")
        return Filter(tuple(names), operator, value)

    def value(self) -> float | str:
        if self.peek() in ("'", '"'):
            return self.quoted()
        for word, value in (("true", 1.0), ("false", 0.0)):
            if self.take(word):
                return value
        return float(self.match(_NUMBER, "a value"))

    def function(self) -> Function:
        at = self.pos
        self.pos += 2
        name = self.match(_WORD, "a function's name")
        if name in _PARTS and self.take("."):
            parts = _PARTS[name]
            part = self.match(_WORD, f"{', '.join(parts[:-1])} or {parts[-1]}")
            if part not in parts:
                self.fail(f"{' or '.join(parts)}, not '{part}'")
            return Function(part)
        if name in _INSTEAD:
            self.pos = at
            self.fail(f"{_INSTEAD[name]}, not '@{name}'")
        if name in BINARY:
            return Function(name, self.argument(name))
        if name != "norm" and name not in UNARY:
            self.pos = at
            close = alike(name, ["norm", *_PARTS, *UNARY, *BINARY]) or "norm"
            self.fail(f"@{close}, not '@{name}'")
        return Function(name)

    def argument(self, name: str) -> float:
        if not self.take("("):
            self.fail(f"@{name}(2)")
        value = float(self.match(_NUMBER, "a number"))
        self.expect(")")
        if not math.isfinite(value) or (name == "div" and value == 0):
            self.fail("a finite number" + ", not 0" * (name == "div"))
        return value

    def quoted(self) -> str:
        mark = self.peek()
        end = self.text.find(mark, self.pos + 1)
        if end < 0:
            self.fail(f"a closing {mark}")
        value = self.text[self.pos + 1 : end]
        self.pos = end + 1
        return value

    def name(self, pattern: re.Pattern[str], what: str) -> str:
        if self.peek() not in ("'", '"'):
            return self.match(pattern, what)
        name = self.quoted()
        if not name:
            self.fail("a name")
        return name

    def peek(self) -> str:
        return self.text[self.pos] if self.pos < len(self.text) else "\0"

    def take(self, mark: str) -> bool:
        if not self.text.startswith(mark, self.pos):
            return False
        self.pos += len(mark)
        return True

    def expect(self, mark: str, what: str = "") -> None:
        if not self.take(mark):
            self.fail(what or repr(mark))

    def blank(self) -> None:
        self.match(_BLANK, "a blank")

    def match(self, pattern: re.Pattern[str], what: str) -> str:
        seen = pattern.match(self.text, self.pos)
        if not seen:
            self.fail(what)
        self.pos = seen.end()
        return seen[0]

    def fail(self, expected: str) -> NoReturn:
        at = self.pos + 1 if self.pos < len(self.text) else 0
        shown = str(self.text)[: LENGTH_LIMIT // 10]
        raise GroundedError(found("file.path", path=shown, at=str(at), expected=expected))
