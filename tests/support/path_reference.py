"""A slow reference for message paths, applied to decoded Python objects one by one."""

from __future__ import annotations

import math
import operator
from typing import Any

from grounded_trials.formats.message_path import Field, Filter, MessagePath, Slice

COMPARE = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
MISSING = object()


def field(value: Any, name: str) -> Any:
    if isinstance(value, dict):
        return value.get(name, MISSING)
    return getattr(value, name, MISSING)


def follow(value: Any, path: MessagePath) -> list[float]:
    """Return all numbers that the path finds in one message."""
    values = [value]
    for step in path.steps:
        found: list[Any] = []
        for v in values:
            if isinstance(step, Field):
                found.append(field(v, step.name))
            elif isinstance(step, Slice):
                items = list(v)
                start = step.start + len(items) if step.start < 0 else step.start
                stop = step.stop + len(items) if step.stop < 0 else step.stop
                if step.is_index:
                    found += [items[start]] if 0 <= start < len(items) else []
                else:
                    found += items[max(start, 0) : stop + 1] if stop >= 0 else []
            elif isinstance(step, Filter):
                inner = v
                for name in step.path:
                    inner = field(inner, name)
                if inner is not MISSING and COMPARE[step.operator](inner, step.value):
                    found.append(v)
        values = [v for v in found if v is not MISSING]
    return [apply(v, path) for v in values]


def apply(value: Any, path: MessagePath) -> float:
    if path.function == "norm":
        return math.sqrt(sum(v * v for v in value))
    if not path.function:
        return float(value)
    x, y, z, w = (field(value, part) for part in "xyzw")
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    return {
        "rpy.roll": math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        "rpy.pitch": math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))),
        "rpy.yaw": math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    }[path.function]
