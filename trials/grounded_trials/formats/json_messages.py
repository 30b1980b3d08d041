"""JSON messages as nodes: parsed one by one, since only each message tells its own types.

null stands for a number that was not one, since JSON has no NaN; some writers write NaN all the
same, and that is read too. What a message lacks drops out.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from grounded_trials.formats.messages import (
    BadMessage,
    BadPath,
    Bools,
    Dynamic,
    Floats,
    Ints,
    choose_items,
)

MESSAGE_LIMIT = 16 * 2**20  # [bytes]; parsed, JSON takes many times its size
_DYNAMIC = Dynamic()


@dataclass(frozen=True, eq=False)
class JsonNode:
    """Row i is the parsed value objects[i]."""

    rows: Ints
    objects: Sequence[Any]
    type: Dynamic = _DYNAMIC

    def keep(self, chosen: Bools) -> JsonNode:
        """See `nodes.Node`."""
        return self._pick(np.flatnonzero(chosen))

    def numbered(self, rows: Ints) -> JsonNode:
        """See `nodes.Node`."""
        return replace(self, rows=rows)

    def names(self) -> tuple[str, ...]:
        """See `nodes.Node`; of the first row that is an object."""
        return next((tuple(o) for o in self.objects if isinstance(o, dict)), ())

    def field(self, name: str) -> JsonNode:
        """See `nodes.Node`."""
        chosen = [i for i, o in enumerate(self.objects) if isinstance(o, dict) and name in o]
        rows = self.rows[np.array(chosen, dtype=np.int64)]
        return JsonNode(rows, [self.objects[i][name] for i in chosen])

    def items(self, start: int, stop: int) -> JsonNode:
        """See `nodes.Node`."""
        lists = [o if isinstance(o, list) else [] for o in self.objects]
        counts = np.array([len(items) for items in lists], dtype=np.int64)
        row, index = choose_items(counts, start, stop)
        pairs = zip(row.tolist(), index.tolist(), strict=True)
        return JsonNode(self.rows[row], [lists[i][j] for i, j in pairs])

    def numbers(self) -> Floats:
        """See `nodes.Node`."""
        values = np.empty(len(self.objects))
        for i, o in enumerate(self.objects):
            if o is None:
                values[i] = np.nan
            elif isinstance(o, int | float):
                values[i] = _as_float(o)
            else:
                what = {"dict": "an object", "list": "a list"}.get(type(o).__name__, "a text")
                raise BadPath(f"it ends at {what} in message {self.rows[i]}, not at a number")
        return values

    def equals(self, text: str) -> Bools:
        """See `nodes.Node`."""
        return np.array([o == text for o in self.objects], dtype=np.bool_)

    def _pick(self, index: Ints) -> JsonNode:
        return JsonNode(self.rows[index], [self.objects[i] for i in index.tolist()])


def json_messages(buffer: bytes, start: Ints, end: Ints) -> JsonNode:
    """JSON messages at buffer[start[i]:end[i]] as the root of a path.

    Raises:
        BadMessage: for one that is not JSON.
    """
    objects = []
    for i, (a, b) in enumerate(zip(start.tolist(), end.tolist(), strict=True)):
        if b - a > MESSAGE_LIMIT:
            raise BadMessage(i, f"it has {b - a} bytes of JSON, the limit is {MESSAGE_LIMIT}")
        try:
            objects.append(json.loads(buffer[a:b]))
        except (ValueError, RecursionError) as error:
            raise BadMessage(i, f"it is not JSON: {error}") from None
    return JsonNode(np.arange(len(objects)), objects)


def _as_float(value: float) -> float:
    try:
        return float(value)
    except OverflowError:  # an integer of hundreds of digits
        return np.inf if value > 0 else -np.inf
