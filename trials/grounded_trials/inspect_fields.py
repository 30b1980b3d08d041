"""The numbers inside a message type, as the paths that lead to them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from grounded_trials.message_path import is_name
from grounded_trials.message_types import Array, Dynamic, Number, Struct, Type
from grounded_trials.path_walk import is_time

FIELD_LIMIT = 200  # paths of one topic
ITEM_LIMIT = 12  # items of a list that are named one by one
DEPTH_LIMIT = 12
VISIT_LIMIT = 20_000  # parts of a type that are looked at; a hostile one has no end
QUATERNION = ("x", "y", "z", "w")


def number_paths(type: Type, sample: Any = None) -> list[str]:
    """Paths (without the topic) to the numbers of a type, quaternions also as angles.

    Args:
        type: of the messages.
        sample: one parsed message, where only it tells the type (JSON).
    """
    found: list[str] = []
    patience = iter(range(VISIT_LIMIT))
    walk = _of_value(sample, 0) if isinstance(type, Dynamic) else _of_type(type, 0, patience)
    for path in walk:
        found.append(path)
        if len(found) >= FIELD_LIMIT:
            break
    return found


def _of_type(type: Type, depth: int, patience: Iterator[int]) -> Iterator[str]:
    if depth > DEPTH_LIMIT or next(patience, None) is None:
        return
    if isinstance(type, Number):
        yield ""
    elif isinstance(type, Array):
        count = ITEM_LIMIT if type.count is None else type.count
        if count <= ITEM_LIMIT:
            for i in range(count if isinstance(type.item, Number) else 1):
                for rest in _of_type(type.item, depth + 1, patience):
                    yield f"[{i}]{rest}"
    elif isinstance(type, Struct) and not is_time(type):
        if tuple(type.by_name) == QUATERNION:
            yield from (f".@rpy.{angle}" for angle in ("roll", "pitch", "yaw"))
        for field in type.fields:
            for rest in _of_type(field.type, depth + 1, patience):
                yield f".{_spell(field.name)}{rest}"


def _of_value(value: Any, depth: int) -> Iterator[str]:
    if depth > DEPTH_LIMIT:
        return
    if isinstance(value, int | float):
        yield ""
    elif isinstance(value, list):
        for i, item in enumerate(value[:ITEM_LIMIT]):
            for rest in _of_value(item, depth + 1):
                yield f"[{i}]{rest}"
    elif isinstance(value, dict):
        if set(value) == set(QUATERNION):
            yield from (f".@rpy.{angle}" for angle in ("roll", "pitch", "yaw"))
        for name, inner in value.items():
            if name and '"' not in name:
                for rest in _of_value(inner, depth + 1):
                    yield f".{_spell(name)}{rest}"


def _spell(name: str) -> str:
    return name if is_name(name) else f'"{name}"'
