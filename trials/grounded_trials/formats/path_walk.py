"""Apply message paths to decoded messages, and list the paths to their numbers.

`evaluate` follows a path in many messages step by step. A value's time stamp is that of the
innermost object on the path that has a `header.stamp`, a `stamp` or a `timestamp`. `number_paths`
lists the paths of an unknown message.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from grounded.checks import near
from grounded.units import in_another_unit
from grounded_trials.formats.bad import BadMessage, BadPath
from grounded_trials.formats.message_path import (
    ANGLES,
    AXES,
    WORLD,
    Field,
    Filter,
    MessagePath,
    Slice,
    Step,
    is_name,
)
from grounded_trials.formats.messages import (
    ABSENT,
    Decoded,
    Floats,
    Ints,
    fields_of,
    is_list,
    names_in,
)

SECONDS, NANOSECONDS = ("sec", "secs", "seconds"), ("nanosec", "nsec", "nsecs", "nanos")
CALENDAR_S = 9_200_000_000  # 2^63 ns: the years 1678 to 2261
STAMPS = (("header", "stamp"), ("stamp",), ("timestamp",), ("header", "timestamp"))
QUATERNION = ("x", "y", "z", "w")
TURNS = (".q", ".q_d")  # of PX4: arrays w, x, y, z
TURNED = ("pose", "pose", "orientation")  # in nav_msgs/Odometry: how the robot's axes are turned,
MOVING = ("twist", "twist", "linear")  # and its velocity along them

Values = list[Any]


@dataclass(frozen=True, eq=False)
class Found:
    """The numbers found: values[i] in message rows[i], with the stamp stamps[i] [ns]."""

    rows: Ints
    values: Floats
    stamps: Ints | None


def evaluate(part: Decoded, path: MessagePath, *, stamps: bool) -> Found:
    """Evaluate a path on messages; with `stamps`, only numbers with one are returned.

    Raises:
        BadMessage: for a stamp outside the calendar.
        BadPath: if a message has no number at the end of the path, suggesting the nearest name.
    """
    if part.columns is not None:
        try:
            return _in_columns(part, path, stamps)
        except BadPath:  # several values, a text, or none
            if part.decode is None:
                raise
    split, names = _stamped(part.objects, path.steps) if stamps else (0, ())
    rows, holders = _walk([*range(len(part.objects))], [*part.objects], path.steps[:split])
    at, ends = _walk([*range(len(rows))], holders, path.steps[split:])
    values = _apply(ends, path.function)
    found, messages = np.array(at, dtype=np.int64), np.array(rows, dtype=np.int64)
    if not names:
        return Found(messages[found], values, None)
    stamped, of = _fields([*range(len(holders))], holders, names)
    known, times = np.zeros(len(holders), np.bool_), np.zeros(len(holders), np.int64)
    known[stamped], times[stamped] = True, _times(of, messages[stamped])
    good = known[found]
    return Found(messages[found[good]], values[good], times[found[good]])


def _in_columns(part: Decoded, path: MessagePath, stamps: bool) -> Found:
    """Evaluate a path on one object whose numbers are columns; refuse one to several."""
    whole, table = [part.columns], part.decode is None
    split, names = _stamped(whole, path.steps) if stamps and not table else (0, ())
    _, holders = _walk([0], whole, path.steps[:split])
    _, ends = _walk([0] * len(holders), holders, path.steps[split:])
    if len(ends) != 1:
        raise BadPath("path", expected="one value", found=str(len(ends) or "nothing"))
    values, rows = _apply(ends, path.function, columns=True), np.arange(len(part.log_times))
    if not table:
        _, of = _fields([0] * len(holders), holders, names)
        return Found(rows, values, _times(of, rows) if names else None)
    # A table of a run may end with a state after its last command.
    count = len(values) - bool(len(values) > 1 and not np.isfinite(values[-1]))
    return Found(rows[:count], values[:count], part.log_times[:count])


def _walk(rows: list[int], values: Values, steps: Sequence[Step]) -> tuple[list[int], Values]:
    """Follow steps from the values of some rows: a row may then have several values, or none."""
    for step in steps:
        if isinstance(step, Slice):
            chosen = [_items(value, step) for value in values]
            rows = [row for row, some in zip(rows, chosen, strict=True) for _ in some]
            values = [item for some in chosen for item in some]
            continue
        if isinstance(step, Field):
            _check_field(values, step.name)
            inner = fields_of(values, step.name)
        else:
            held = zip(values, _passes(values, step), strict=True)
            inner = [value if passed else ABSENT for value, passed in held]
        rows = [row for row, one in zip(rows, inner, strict=True) if one is not ABSENT]
        values = [one for one in inner if one is not ABSENT]
    return rows, values


def _fields(rows: list[int], values: Values, names: Sequence[str]) -> tuple[list[int], Values]:
    """Follow names of fields, as `_walk` does."""
    return _walk(rows, values, [Field(name) for name in names])


def _check_field(values: Values, name: str) -> None:
    """Check that values may have a field: a JSON object may have any."""
    first: Any = next((one for one in values if one is not None), {})
    names = names_in(first)
    if isinstance(first, dict) or name in names:
        return
    if not names:
        expected = "[0] or [:]" if is_list(first) else "message"
        raise BadPath("path", at=name, expected=expected, found=_kind(first))
    there = [one for one in names if one != "header"]
    alike = in_another_unit(name, there)
    others: dict[str, Any] = {"near": alike[0]} if alike else near(name, there)
    raise BadPath("given.name", name, kind="field", of=_kind(first), **others)


def _kind(value: Any) -> str:
    """Return what to call a value's type in a message."""
    described = getattr(value, "DESCRIPTOR", None)
    named = getattr(value, "__msgtype__", "") or (described.full_name if described else "")
    return str(named) or ("list" if is_list(value) else type(value).__name__)


def _items(value: Any, step: Slice) -> Values:
    """Return the items of a list from start to stop, both included; negative counts from the end.

    Indices outside the list are left out, as in Foxglove.
    """
    if value is None:
        return []
    if not is_list(value):
        raise BadPath("path", at="[...]", expected="list", found=_kind(value))
    count = len(value)
    first, last = (i + count if i < 0 else i for i in (step.start, step.stop))
    if step.is_index and first < 0:
        return []
    return [value[i] for i in range(max(first, 0), min(last, count - 1) + 1)]


_COMPARE: dict[str, Callable[[Any, Any], bool]] = {
    **{"==": operator.eq, "!=": operator.ne},
    **{"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge},
}


def _passes(values: Values, step: Filter) -> list[bool]:
    """Return where a filter holds; it does not without its field."""
    passes = [False] * len(values)
    rows, inner = _fields([*range(len(values))], values, step.path)
    for row, value in zip(rows, inner, strict=True):
        value = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
        known = value is None or isinstance(value, str) or _is_number(value)
        if not known or isinstance(value, str) != isinstance(step.value, str):
            expected, at = type(step.value).__name__, ".".join(step.path)
            raise BadPath("path", at=at, expected=expected, found=_kind(value))
        passes[row] = value is not None and bool(_COMPARE[step.operator](value, step.value))
    return passes


# Time stamps


def _stamped(objects: Sequence[Any], steps: Sequence[Step]) -> tuple[int, tuple[str, ...]]:
    """Return after how many steps a path is in the object with the stamp, and the names to it.

    The first message decides that the path goes through.
    """
    found = 0, _stamp_in(next(iter(objects), None))
    for one in objects:
        values: Values = [one]
        for i, step in enumerate(steps, start=1):
            if not isinstance(step, Filter):
                way = Slice(0, -1) if isinstance(step, Slice) else step
                values = _walk([0] * len(values), values, [way])[1][:1]
            if values and (names := _stamp_in(values[0])):
                found = i, names
        if values:
            break
    return found


def _stamp_in(value: Any) -> tuple[str, ...]:
    """Return the names that lead from an object to its time stamp, () if it has none."""
    return next((names for names in STAMPS if is_time(_inside(value, names))), ())


def _inside(value: Any, names: Sequence[str]) -> Any:
    """Return what names lead to in an object, None if one of them is not there."""
    for name in names:
        value = fields_of([value], name)[0] if name in names_in(value) else None
    return value


def is_time(value: Any) -> bool:
    """Check whether an object is a time: seconds and nanoseconds, under any usual names."""
    names = names_in(value)
    return len(names) == 2 and names[0] in SECONDS and names[1] in NANOSECONDS


def _times(stamps: Values, messages: Ints) -> Ints:
    """Return stamps [ns], of some messages, within the calendar."""
    if not stamps:
        return np.zeros(0, np.int64)
    whole, rest = (_part(stamps, part).ravel() for part in names_in(stamps[0]))
    outside = ~((np.abs(whole) <= CALENDAR_S) & (np.abs(rest) < 2**32))
    if outside.any():
        k = int(np.argmax(outside))
        at = f"{whole[k]:g} s {rest[k]:g} ns"
        raise BadMessage(messages[k], "decode", what="stamp", at=at)
    times: Ints = whole.astype(np.int64) * 10**9 + rest.astype(np.int64)
    return times


# The number at the end


def _apply(values: Values, function: str, *, columns: bool = False) -> Floats:
    """Return the numbers at the end of a path, of its function if it has one."""
    kind = function.rpartition(".")[2]
    if kind in ANGLES:
        return _angle(kind, _turn(values))
    if kind in AXES:
        return _in_world(values, AXES.index(kind))
    if kind == "norm":
        return np.array([_norm(value) for value in values], dtype=np.float64).reshape(-1)
    if not columns:
        return _numbers(values)
    if not isinstance(values[0], np.ndarray) or values[0].ndim != 1:
        raise BadPath("path", expected="number", found="list")
    return np.array(values[0], dtype=np.float64)


def _numbers(values: Values) -> Floats:
    """Return numbers as an array, NaN for None (null in JSON, which has no NaN)."""
    bad = next((v for v in values if not (v is None or _is_number(v))), None)
    if bad is not None:
        known = tuple(names_in(bad)) or (("[0]", "[:]") if is_list(bad) else ())
        raise BadPath("path", expected="number", found=_kind(bad), known=known)
    try:
        return np.array(values, dtype=np.float64)
    except OverflowError:  # an integer of hundreds of digits
        return np.array([np.inf if abs(v or 0) > 2**63 else v for v in values], dtype=np.float64)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number | np.bool_)


def _part(values: Values, *names: str) -> Floats:
    """Return a number of each object, NaN where it is absent; of a table (1, N)."""
    found: Values = [np.nan] * len(values)
    for row, value in zip(*_fields([*range(len(values))], values, names), strict=True):
        found[row] = value
    return _column(found)


def _column(values: Values) -> Floats:
    """Return numbers of objects, (N,), or of a table, (1, N)."""
    of_table = any(isinstance(one, np.ndarray) for one in values)
    return np.array(values, dtype=np.float64) if of_table else _numbers(values)


def _turn(values: Values, *names: str) -> Floats:
    """Return the quaternions (4, N), x y z w, that names lead to, of length 1; NaN for zero."""
    turns = _fields([0] * len(values), values, names)[1]
    known = [one for one in turns if one is not None]
    if all(is_list(one) and len(one) == 4 for one in known):
        some = [[None if one is None else one[i] for one in turns] for i in (1, 2, 3, 0)]
        quaternion = np.array([_column(parts).ravel() for parts in some])
    elif all({*QUATERNION} <= {*names_in(one)} for one in known):
        quaternion = np.array([_part(turns, name).ravel() for name in QUATERNION])
    else:
        raise BadPath("path", at="@rpy", expected="x, y, z, w", found=_kind(known[0]))
    with np.errstate(invalid="ignore", divide="ignore"):
        unit: Floats = quaternion / np.sqrt((quaternion**2).sum(axis=0))
    return unit


def _matrix(turn: Floats) -> Sequence[Sequence[Floats]]:
    """Return R = Rz(yaw) Ry(pitch) Rx(roll) of quaternions (4, N), row by row."""
    x, y, z, w = turn
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def _angle(name: str, turn: Floats) -> Floats:
    """Return roll, pitch or yaw [rad] of quaternions; NaN for zero."""
    R = _matrix(turn)
    if name == "pitch":
        return np.arcsin(np.clip(0.0 - R[2][0], -1, 1))
    return np.arctan2(R[2][1], R[2][2]) if name == "roll" else np.arctan2(R[1][0], R[0][0])


def _in_world(values: Values, axis: int) -> Floats:
    """Return one axis of R v, with R of the pose and v along the robot's axes [m/s]."""
    if not all(map(_is_odometry, values)):
        both = f"{'.'.join(TURNED)} and {'.'.join(MOVING)}"
        raise BadPath("path", at=f"@{WORLD}", expected=both, found=_kind(values[0]))
    row = _matrix(_turn(values, *TURNED))[axis]
    v = [_part(values, *MOVING, name).ravel() for name in AXES]
    return row[0] * v[0] + row[1] * v[1] + row[2] * v[2]


def _is_odometry(value: Any) -> bool:
    """Check whether an object has a pose and, in the robot's own axes, a velocity."""
    parts = ((TURNED, QUATERNION), (MOVING, AXES))
    return all({*some} <= {*names_in(_inside(value, names))} for names, some in parts)


def _norm(value: Any) -> Any:
    """Return the length of a vector: a list of numbers, or an object's; of a table (N,)."""
    if value is None:
        return np.nan
    parts = value if is_list(value) else [fields_of([value], n)[0] for n in names_in(value)]
    parts = [one for one in parts if _is_number(one) or isinstance(one, np.ndarray)]
    if not parts:
        raise BadPath("path", at="@norm", expected="numbers", found=_kind(value))
    return np.sqrt(sum(_column([one])[0] ** 2 for one in parts))


FIELD_LIMIT = 200  # paths listed per topic
ITEM_LIMIT = 12  # longer lists are pictures or scans, no signals
DEPTH_LIMIT = 12


def number_paths(message: Any) -> list[str]:
    """List the paths (without the topic) to the numbers of a message.

    Angles of quaternions and the velocity of an Odometry in its pose's axes are listed, too.
    """
    paths = list(islice(_paths_in(message, 0), FIELD_LIMIT))
    return paths + [f".@{WORLD}.{axis}" for axis in AXES if _is_odometry(message)]


def _paths_in(value: Any, depth: int) -> Iterator[str]:
    """Yield the paths inside a value."""
    if depth > DEPTH_LIMIT:
        return
    if _is_number(value):
        yield ""
    if {*names_in(value)} == {*QUATERNION}:
        yield from (f".@rpy.{angle}" for angle in ANGLES)
    for step, inner in _steps_into(value):
        if step in TURNS and is_list(inner) and len(inner) == 4:
            yield from (f"{step}.@rpy.{angle}" for angle in ANGLES)
        for rest in _paths_in(inner, depth + 1):
            yield step + rest


def _steps_into(value: Any) -> list[tuple[str, Any]]:
    """Return the parts of an object or a list, each with the step that leads to it."""
    if is_list(value) and not len(value) > ITEM_LIMIT:
        return [(f"[{i}]", item) for i, item in enumerate(value)]
    names = () if is_time(value) else names_in(value)
    parts = ((name, fields_of([value], name)[0]) for name in names if name and '"' not in name)
    return [("." + (name if is_name(name) else f'"{name}"'), one) for name, one in parts]
