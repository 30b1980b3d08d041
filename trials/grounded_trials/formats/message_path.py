"""Parse message paths in Foxglove's syntax, which select a number in a topic's messages.

    /odom.pose.pose.orientation.@rpy.yaw      a field, then a function of it
    /motors.current[2]   .ranges[-1]          an item; negative counts from the end
    /tf.transforms[:]{child_frame_id=="car"}.transform.translation.x
                                              a slice (both ends included), a filter on its items
    "/odd topic.name".data                    names with dots or blanks in quotes

Functions: @rpy.roll|pitch|yaw of a quaternion, @world_velocity.x|y|z of an Odometry message, @norm
of a vector or list, and of a number: @abs @negative @sign @sqrt @sin @cos @tan @asin @acos @atan
@exp @log @ceil @floor @round @deg2rad @rad2deg @add(c) @sub(c) @mul(c) @div(c). Filters compare
with == != < <= > >=; several may follow each other or be joined by &&. This module only parses;
`path_walk` applies a path to messages.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache
from typing import NoReturn

from grounded.errors import GroundedError, nearest

_TRIGONOMETRY = ("sin", "cos", "tan", "asin", "acos", "atan")
_ROUNDING = ("abs", "negative", "sign", "ceil", "floor", "round")
UNARY = (*_TRIGONOMETRY, *_ROUNDING, "sqrt", "exp", "log", "deg2rad", "rad2deg")
BINARY = ("add", "sub", "mul", "div")
ANGLES = ("roll", "pitch", "yaw")
AXES = ("x", "y", "z")
WORLD = "world_velocity"  # an Odometry's velocity, turned from the robot's axes into its pose's
LENGTH_LIMIT = 1000  # characters in a path

_REFUSED = {
    "delta": "differences amplify noise; measure the state or let [estimate] smooth it",
    "derivative": "differences amplify noise; measure the state or let [estimate] smooth it",
    "timedelta": "times between messages are not a signal",
    "quat": "it gives four numbers; use a field of the orientation",
    "rpy": "name the angle: .@rpy.roll, .@rpy.pitch or .@rpy.yaw",
    WORLD: "name the axis: .@world_velocity.x, .@world_velocity.y or .@world_velocity.z",
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
            raise GroundedError("a message path is empty; expected the form /topic.field")
        if len(self.text) > LENGTH_LIMIT:
            raise GroundedError(f"a message path has more than {LENGTH_LIMIT} characters")
        topic = self.name(_TOPIC, "a topic")
        steps: list[Step] = []
        functions: list[Function] = []
        while self.pos < len(self.text):
            if self.text.startswith(".@", self.pos):
                functions.append(self.function())
            elif functions:
                self.fail("expected a function or the end, since functions come last")
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
        self.fail("expected '.field', '[index]', '{filter}' or '.@function'")

    def slice(self) -> Slice:
        self.pos += 1
        start = self.integer()
        if self.take("]"):
            if start is None:
                self.fail("expected an index such as [0], or [:] for all items")
            return Slice(start, start)
        self.expect(":", "':' or ']'")
        stop = self.integer()
        self.expect("]")
        return Slice(0 if start is None else start, -1 if stop is None else stop)

    def integer(self) -> int | None:
        if self.peek() == "$":
            self.fail("variables such as $name are not supported; write the number")
        found = _INTEGER.match(self.text, self.pos)
        if not found:
            return None
        self.pos = found.end()
        return int(found[0])

    def filters(self) -> list[Filter]:
        self.pos += 1
        found = [self.filter()]
        while self.take("&&"):
            found.append(self.filter())
        self.expect("}")
        return found

    def filter(self) -> Filter:
        self.blank()
        names = [self.match(_NAME, "a field's name")]
        while self.take("."):
            names.append(self.match(_NAME, "a field's name"))
        self.blank()
        operator = self.match(_OPERATOR, "one of == != < <= > >=")
        self.blank()
        value = self.value()
        self.blank()
        if isinstance(value, str) and operator not in ("==", "!="):
            self.fail("a text can only be compared with == and !=")
        return Filter(tuple(names), operator, value)

    def value(self) -> float | str:
        if self.peek() in ("'", '"'):
            return self.quoted()
        for word, value in (("true", 1.0), ("false", 0.0)):
            if self.take(word):
                return value
        return float(self.match(_NUMBER, "a number, a text in quotes, true or false"))

    def function(self) -> Function:
        at = self.pos
        self.pos += 2
        name = self.match(_WORD, "a function's name")
        if name in _PARTS and self.take("."):
            parts = _PARTS[name]
            part = self.match(_WORD, f"{', '.join(parts[:-1])} or {parts[-1]}")
            if part not in parts:
                self.fail(f"'@{name}' has no '{part}': {nearest(part, parts)}")
            return Function(part)
        if name in _REFUSED:
            self.pos = at
            self.fail(f"'@{name}' can't be used: {_REFUSED[name]}")
        if name in BINARY:
            return Function(name, self.argument(name))
        if name != "norm" and name not in UNARY:
            self.pos = at
            self.fail(f"no function '@{name}': {nearest(name, ['norm', *_PARTS, *UNARY, *BINARY])}")
        return Function(name)

    def argument(self, name: str) -> float:
        if not self.take("("):
            self.fail(f"'@{name}' needs a number, such as @{name}(2)")
        value = float(self.match(_NUMBER, "a number"))
        self.expect(")")
        if not math.isfinite(value) or (name == "div" and value == 0):
            self.fail(f"'@{name}' needs a finite number, and no division by 0")
        return value

    def quoted(self) -> str:
        mark = self.peek()
        end = self.text.find(mark, self.pos + 1)
        if end < 0:
            self.fail(f"the text that begins with {mark} has no closing quote")
        value = self.text[self.pos + 1 : end]
        self.pos = end + 1
        return value

    def name(self, pattern: re.Pattern[str], what: str) -> str:
        if self.peek() not in ("'", '"'):
            return self.match(pattern, what)
        name = self.quoted()
        if not name:
            self.fail("a name in quotes is empty")
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
            self.fail(f"expected {what or repr(mark)}")

    def blank(self) -> None:
        self.match(_BLANK, "a blank or none")

    def match(self, pattern: re.Pattern[str], what: str) -> str:
        found = pattern.match(self.text, self.pos)
        if not found:
            self.fail(f"expected {what}")
        self.pos = found.end()
        return found[0]

    def fail(self, problem: str) -> NoReturn:
        where = "its end" if self.pos >= len(self.text) else f"character {self.pos + 1}"
        raise GroundedError(f"message path '{self.text}', {where}: {problem}")
