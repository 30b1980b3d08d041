"""Apply message paths: check them against a type, evaluate them, list the paths of a type.

`bind` checks a path against a type once, and finds the time stamp of its value: in the innermost
struct on the path that has a `header.stamp`, a `stamp` or a `timestamp`. `evaluate` then walks the
nodes of many messages by array operations. `number_paths` lists the paths of an unknown type.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from grounded.checks import near
from grounded.errors import type_of
from grounded.units import in_another_unit
from grounded_trials.formats.bad import BadMessage, BadPath
from grounded_trials.formats.message_path import (
    ANGLES,
    AXES,
    BINARY,
    UNARY,
    WORLD,
    Field,
    Filter,
    Function,
    MessagePath,
    Slice,
    Step,
    is_name,
)
from grounded_trials.formats.messages import (
    Array,
    Bools,
    Dynamic,
    Floats,
    Ints,
    Node,
    Number,
    Struct,
    Text,
    Type,
)

SECONDS, NANOSECONDS = ("sec", "secs", "seconds"), ("nanosec", "nsec", "nsecs", "nanos")
CALENDAR_S = 9_200_000_000  # 2^63 ns: the years 1678 to 2261
STAMPS = (("header", "stamp"), ("stamp",), ("timestamp",), ("header", "timestamp"))
QUATERNION = ("x", "y", "z", "w")
TURNS = (".q", ".q_d")  # of PX4: arrays w, x, y, z
TURNED = ("pose", "pose", "orientation")  # in nav_msgs/Odometry: how the robot's axes are turned,
MOVING = ("twist", "twist", "linear")  # and its velocity along them


@dataclass(frozen=True)
class Bound:
    """A path that fits a type, split at the struct with the stamp."""

    before: tuple[Step, ...]
    after: tuple[Step, ...]
    stamp: tuple[str, ...] | None  # names from that struct to the stamp; None: there is none
    functions: tuple[Function, ...]


@dataclass(frozen=True, eq=False)
class Values:
    """The values found: values[i] in message rows[i], with the stamp stamps[i] [ns]."""

    rows: Ints
    values: Floats
    stamps: Ints | None


def bind(path: MessagePath, type: Type) -> Bound:
    """Check a path against the type of a topic's messages.

    Raises:
        BadPath: if it does not fit, suggesting the nearest name.
    """
    split, stamp = 0, _stamp_in(type)
    for i, step in enumerate(path.steps):
        type = _into(type, step)
        rest = path.steps[i + 1 :]
        found = _stamp_in(type)
        if found is not None and all(not isinstance(s, Slice) or s.is_index for s in rest):
            split, stamp = i + 1, found
    _check_end(type, path)
    return Bound(path.steps[:split], path.steps[split:], stamp, path.functions)


def _into(type: Type, step: Step) -> Type:
    if isinstance(type, Dynamic):
        return type
    if isinstance(step, Slice):
        if not isinstance(type, Array):
            raise BadPath("path", at="[...]", expected="list", found=str(type))
        return type.item
    names = (step.name,) if isinstance(step, Field) else step.path
    inner: Type = type
    for name in names:
        inner = _field(inner, name)
    if isinstance(step, Field):
        return inner
    wanted = Text if isinstance(step.value, str) else Number
    if not isinstance(inner, wanted):
        raise BadPath("path", at=".".join(names), expected=type_of(step.value), found=str(inner))
    return type


def _field(type: Type, name: str) -> Type:
    if isinstance(type, Array):
        raise BadPath("path", at=name, expected="[0] or [:]", found=str(type))
    if not isinstance(type, Struct):
        raise BadPath("path", at=name, expected="message", found=str(type))
    if name not in type.by_name:
        there = [one for one in type.by_name if one != "header"]
        alike = in_another_unit(name, there)
        others: dict[str, Any] = {"near": alike[0]} if alike else near(name, there)
        raise BadPath("given.name", name, kind="field", of=str(type), **others)
    return type.by_name[name].type


def _check_end(type: Type, path: MessagePath) -> None:
    if isinstance(type, Dynamic):
        return
    name = path.functions[0].name if path.functions else ""
    if name in ANGLES:
        fits = isinstance(type, Struct) and all(_is_number(type, part) for part in QUATERNION)
        if not fits and not _is_turn(type):
            raise BadPath("path", at="@rpy", expected="x, y, z, w", found=str(type))
    elif name in AXES:
        if not _is_odometry(type):
            both = f"{'.'.join(TURNED)} and {'.'.join(MOVING)}"
            raise BadPath("path", at=f"@{WORLD}", expected=both, found=str(type))
    elif name == "norm":
        fits = isinstance(type, Array) and isinstance(type.item, Number)
        if not fits and not (isinstance(type, Struct) and _numbers_of(type)):
            raise BadPath("path", at="@norm", expected="numbers", found=str(type))
    elif isinstance(type, Struct):
        raise BadPath("path", expected="number", found=str(type), known=tuple(type.by_name))
    elif isinstance(type, Array):
        raise BadPath("path", expected="number", found=str(type), known=("[0]", "[:]"))
    elif not isinstance(type, Number):
        raise BadPath("path", expected="number", found=str(type))


def _is_odometry(type: Type) -> bool:
    """Check whether a struct has a pose and, in the robot's own axes, a velocity."""
    for names, parts in ((TURNED, QUATERNION), (MOVING, AXES)):
        inner: Type = type
        for name in names:
            if not isinstance(inner, Struct) or name not in inner.by_name:
                return False
            inner = inner.by_name[name].type
        if not isinstance(inner, Struct) or not all(_is_number(inner, part) for part in parts):
            return False
    return True


def _is_turn(type: Any) -> bool:
    """Check whether a type is an array of four numbers: a quaternion w, x, y, z."""
    return isinstance(type, Array) and type.count == 4 and isinstance(type.item, Number)


def _is_number(type: Struct, name: str) -> bool:
    return name in type.by_name and isinstance(type.by_name[name].type, Number)


def _numbers_of(type: Struct) -> list[str]:
    return [field.name for field in type.fields if isinstance(field.type, Number)]


def _stamp_in(type: Type) -> tuple[str, ...] | None:
    """Return the names that lead from a struct to its time stamp; None if it has none."""
    for names in STAMPS:
        inner: Type = type
        for name in names:
            if not isinstance(inner, Struct) or name not in inner.by_name:
                break
            inner = inner.by_name[name].type
        else:
            if isinstance(inner, Struct) and is_time(inner):
                return names
    return None


def is_time(type: Struct) -> bool:
    """Check whether a struct is a time: seconds and nanoseconds, under any usual names."""
    names = tuple(type.by_name)
    return len(names) == 2 and names[0] in SECONDS and names[1] in NANOSECONDS


def evaluate(root: Node, bound: Bound, stamps: bool) -> Values:
    """Evaluate a path on messages.

    Args:
        root: node of the messages.
        bound: the path.
        stamps: whether to read the time stamps too.

    Raises:
        BadMessage: if a message does not match its type.
        BadPath: if a JSON message has no number at the end of the path.
    """
    node = walk(root, bound.before)
    messages = node.rows
    with _numbered(node) as numbered:
        end = walk(numbered, bound.after)
        rows, values = _apply(end, bound.functions)
        names = _dynamic_stamp(numbered) if isinstance(root.type, Dynamic) else bound.stamp
        if not stamps or names is None:
            return Values(messages[rows], values, None)
        place, times = read_stamp(walk(numbered, tuple(Field(name) for name in names)))
    at = np.searchsorted(place, rows)
    known = np.append(place, -1)[at] == rows
    return Values(messages[rows[known]], values[known], times[at[known]])


@contextmanager
def _numbered(node: Node) -> Iterator[Node]:
    """Provide the node with rows counted from 0; map row numbers in errors back to messages."""
    try:
        yield node.numbered(np.arange(len(node.rows)))
    except BadMessage as error:
        error.message = int(node.rows[error.message])
        raise


def _dynamic_stamp(root: Node) -> tuple[str, ...] | None:
    """Return the names that lead to the stamp in JSON messages, judging by the first one."""
    first = root.keep(np.arange(len(root.rows)) == 0)
    for names in STAMPS:
        found = walk(first, tuple(Field(name) for name in names)).names()
        if any(n in found for n in SECONDS) and any(n in found for n in NANOSECONDS):
            return names
    return None


def walk(node: Node, steps: Sequence[Step]) -> Node:
    """Follow steps from a node."""
    for step in steps:
        if isinstance(step, Field):
            node = node.field(step.name)
        elif isinstance(step, Slice):
            node = node.items(step.start, step.stop)
        else:
            node = node.keep(_passes(node, step))
    return node


def read_stamp(node: Node) -> tuple[Ints, Ints]:
    """Return rows and times [ns] of a stamp with the field names of ROS 1, ROS 2 or protobuf."""
    names = node.names()
    parts = [next((n for n in known if n in names), "") for known in (SECONDS, NANOSECONDS)]
    if "" in parts:
        none = np.zeros(0, dtype=np.int64)
        return none, none
    seconds, rest = (node.field(name) for name in parts)
    both = np.isin(seconds.rows, rest.rows), np.isin(rest.rows, seconds.rows)
    seconds, rest = seconds.keep(both[0]), rest.keep(both[1])
    whole, part = (n.numbers() for n in (seconds, rest))
    outside = ~((np.abs(whole) <= CALENDAR_S) & (np.abs(part) < 2**32))
    if outside.any():
        k = int(np.argmax(outside))
        raise BadMessage(
            seconds.rows[k], "decode", what="stamp", at=f"{whole[k]:g} s {part[k]:g} ns"
        )
    return seconds.rows, whole.astype(np.int64) * 10**9 + part.astype(np.int64)


def _passes(node: Node, step: Filter) -> Bools:
    """Return where a filter holds; it does not in rows without its field."""
    with _numbered(node) as inner:
        for name in step.path:
            inner = inner.field(name)
        if isinstance(step.value, str):
            holds = inner.equals(step.value)
            holds = ~holds if step.operator == "!=" else holds
        else:
            holds = _COMPARE[step.operator](inner.numbers(), step.value)
    passes = np.zeros(len(node.rows), dtype=np.bool_)
    passes[inner.rows[holds]] = True
    return passes


_COMPARE: dict[str, Callable[[Floats, float], Bools]] = {
    "==": lambda a, b: a == b,
    "!=": lambda a, b: a != b,
    "<": lambda a, b: a < b,
    "<=": lambda a, b: a <= b,
    ">": lambda a, b: a > b,
    ">=": lambda a, b: a >= b,
}


def _apply(node: Node, functions: Sequence[Function]) -> tuple[Ints, Floats]:
    """Return the values at the end of a path after its functions, as (rows, values)."""
    first, rest = (functions[0].name, functions[1:]) if functions else ("", ())
    if first in ANGLES:
        rows, values = node.rows, _angle(first, node)
    elif first in AXES:
        rows, values = node.rows, _in_world(node, AXES.index(first))
    elif first == "norm":
        rows, values = node.rows, _norm(node)
    else:
        rows, values, rest = node.rows, node.numbers(), tuple(functions)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for function in rest:
            argument = (function.argument,) if function.name in BINARY else ()
            values = _FUNCTIONS[function.name](values, *argument)
    return rows, values


def _part(node: Node, *names: str) -> Floats:
    """Return a number of a struct for each row; NaN where it is absent."""
    values = np.full(len(node.rows), np.nan)
    with _numbered(node) as numbered:
        inner = walk(numbered, tuple(Field(name) for name in names))
        values[inner.rows] = inner.numbers()
    return values


def _turn(node: Node, *names: str) -> list[Floats]:
    """Return the quaternion (x, y, z, w) that names lead to, of length 1; NaN for zero."""
    if isinstance(node.type, Array):
        quaternion = [node.items(i, i).numbers() for i in (1, 2, 3, 0)]
    else:
        quaternion = [_part(node, *names, name) for name in QUATERNION]
    with np.errstate(invalid="ignore", divide="ignore"):
        norm = np.sqrt(sum(q**2 for q in quaternion))
        return [q / norm for q in quaternion]


def _angle(name: str, node: Node) -> Floats:
    """Return roll, pitch or yaw [rad] for R = Rz(yaw) Ry(pitch) Rx(roll); NaN for zero."""
    x, y, z, w = _turn(node)
    if name == "pitch":
        return np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    if name == "roll":
        return np.arctan2(2 * (w * x + y * z), 1 - 2 * (x**2 + y**2))
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))


def _in_world(node: Node, axis: int) -> Floats:
    """Return one axis of R v, with R of the pose and v along the robot's axes [m/s]."""
    x, y, z, w = _turn(node, *TURNED)
    v = [_part(node, *MOVING, name) for name in AXES]
    row = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )[axis]
    return row[0] * v[0] + row[1] * v[1] + row[2] * v[2]


def _norm(node: Node) -> Floats:
    if isinstance(node.type, Struct):
        names: Sequence[str] = _numbers_of(node.type)
    else:
        names = node.names()
    if names:
        return np.sqrt(sum((_part(node, name) ** 2 for name in names), np.zeros(len(node.rows))))
    with _numbered(node) as numbered:
        items = numbered.items(0, -1)
        return np.sqrt(np.bincount(items.rows, items.numbers() ** 2, minlength=len(node.rows)))


_NUMPY = {"asin": "arcsin", "acos": "arccos", "atan": "arctan"}  # names in NumPy
_FUNCTIONS: dict[str, Callable[..., Floats]] = {
    name: getattr(np, _NUMPY.get(name, name)) for name in UNARY
} | {"add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide}


FIELD_LIMIT = 200  # paths listed per topic
ITEM_LIMIT = 12  # items of a list that are listed individually
DEPTH_LIMIT = 12
VISIT_LIMIT = 20_000  # parts of a type that are visited; a malicious one may be endless


def number_paths(type: Type, sample: Any = None) -> list[str]:
    """List the paths (without the topic) to the numbers of a type.

    Angles of quaternions and the velocity of an Odometry in its pose's axes are listed, too.

    Args:
        type: of the messages.
        sample: one parsed message, if the type is dynamic (JSON).
    """
    inside = sample if isinstance(type, Dynamic) else type
    paths = list(islice(_paths_in(inside, 0, iter(range(VISIT_LIMIT))), FIELD_LIMIT))
    return paths + [f".@{WORLD}.{axis}" for axis in AXES if _is_odometry(type)]


def _paths_in(thing: Any, depth: int, patience: Iterator[int]) -> Iterator[str]:
    """Yield the paths inside a type, or inside a parsed JSON value."""
    if depth > DEPTH_LIMIT or next(patience, None) is None:
        return
    if isinstance(thing, Number | int | float):
        yield ""
    names = tuple(thing.by_name) if isinstance(thing, Struct) else ()
    if names == QUATERNION or (isinstance(thing, dict) and set(thing) == set(QUATERNION)):
        yield from (f".@rpy.{angle}" for angle in ANGLES)
    for step, inner in _steps_into(thing):
        if step in TURNS and _is_turn(inner):
            yield from (f"{step}.@rpy.{angle}" for angle in ANGLES)
        for rest in _paths_in(inner, depth + 1, patience):
            yield step + rest


def _steps_into(thing: Any) -> list[tuple[str, Any]]:
    """Return the parts of a struct or array, each with the step that leads to it."""
    if isinstance(thing, Array):
        count = ITEM_LIMIT if thing.count is None else thing.count
        named = (count if isinstance(thing.item, Number) else 1) * (count <= ITEM_LIMIT)
        return [(f"[{i}]", thing.item) for i in range(named)]
    if isinstance(thing, Struct) and not is_time(thing):
        return [(f".{_spell(field.name)}", field.type) for field in thing.fields]
    if isinstance(thing, list):
        return [(f"[{i}]", item) for i, item in enumerate(thing[:ITEM_LIMIT])]
    if isinstance(thing, dict):
        return [(f".{_spell(n)}", inner) for n, inner in thing.items() if n and '"' not in n]
    return []


def _spell(name: str) -> str:
    return name if is_name(name) else f'"{name}"'
