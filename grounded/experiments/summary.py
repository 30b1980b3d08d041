"""Numbers that studies report: means with standard errors, improvements, slopes, tables.

Improvement of a utility (never positive) from U_0 to U: (U - U_0) / |U_0|, so 0.76 means that 76 %
of the cost is gone. The paper does not say whether its 76 % is a mean of ratios or a ratio of
means; both are given.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Table:
    """A title, column heads and rows of text, for the terminal and for docs/experiments.md."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def improvement(before: float, after: float) -> float:
    """Share of the cost that is gone."""
    return (after - before) / abs(before)


def mean_se(values: Sequence[float]) -> tuple[float, float]:
    """Mean and one standard error of it (nan for fewer than two values)."""
    data = np.asarray(values, dtype=float)
    if len(data) < 2:
        return (float(data.mean()) if len(data) else math.nan), math.nan
    return float(data.mean()), float(data.std(ddof=1) / math.sqrt(len(data)))


def jsonable(value: Any) -> Any:
    """The same with null for numbers that JSON does not have (nan, infinities)."""
    if isinstance(value, Mapping):
        return {key: jsonable(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def slope(x: Sequence[float], y: Sequence[float]) -> tuple[float, float]:
    """Least-squares slope of log y over log x, and its standard error."""
    u, v = np.log(np.asarray(x, dtype=float)), np.log(np.asarray(y, dtype=float))
    centred = u - u.mean()
    value = float(centred @ v / (centred @ centred))
    left = v - v.mean() - value * centred
    spread = math.sqrt(float(left @ left) / max(len(u) - 2, 1) / float(centred @ centred))
    return value, spread
