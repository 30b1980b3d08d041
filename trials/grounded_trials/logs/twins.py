"""Twins: signals of different topics that show the same motion, perhaps with opposite signs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from grounded_trials.formats.messages import Floats, Ints

SAME = 0.95  # correlation above which two signals show the same motion
LEAST = 30  # fewest samples
KINDS = (
    *(f"@rpy.{angle}" for angle in ("roll", "pitch", "yaw")),
    *(f"{place}.{axis}" for place in ("position", "translation") for axis in "xyz"),
    *(f"{rate}.{axis}" for rate in ("linear", "angular") for axis in "xyz"),
)


@dataclass(frozen=True)
class Twins:
    """Two signals with the same motion; the correlation is negative if their signs differ."""

    first: str  # message paths
    second: str
    correlation: float

    @property
    def opposite(self) -> bool:
        """Whether the two have opposite signs."""
        return self.correlation < 0


def measured_kind(path: str) -> str:
    """Return what a path measures, such as position.x; "" if its name does not show it."""
    return next((kind for kind in KINDS if path.endswith("." + kind)), "")


def find_twins(samples: Mapping[str, tuple[Ints, Floats]]) -> tuple[Twins, ...]:
    """Find signals of the same kind that show the same motion.

    Args:
        samples: stamps [ns] and values by message path.
    """
    found = []
    for first, second in combinations(samples, 2):
        if measured_kind(first) == measured_kind(second) != "":
            correlation = _correlation(samples[first], samples[second])
            if abs(correlation) >= SAME:
                found.append(Twins(first, second, correlation))
    return tuple(found)


def _correlation(a: tuple[Ints, Floats], b: tuple[Ints, Floats]) -> float:
    """Return the correlation of the slower signal with the other one at its stamps."""
    (ta, ya), (tb, yb) = sorted((_clean(*a), _clean(*b)), key=lambda s: len(s[0]))
    inside = (ta >= tb[0]) & (ta <= tb[-1]) if len(tb) else np.zeros(len(ta), dtype=np.bool_)
    if inside.sum() < LEAST:
        return 0.0
    other = np.interp((ta[inside] - ta[0]) * 1e-9, (tb - ta[0]) * 1e-9, yb)
    one = ya[inside]
    if min(one.std(), other.std()) < 1e-3 * max(one.std(), other.std(), 1e-9):
        return 0.0
    return float(np.corrcoef(one, other)[0, 1])


def _clean(t: Ints, y: Floats) -> tuple[Ints, Floats]:
    finite = np.isfinite(y)
    t, y = t[finite], y[finite]
    order = np.argsort(t, kind="stable")
    t, y = t[order], y[order]
    keep = np.append(True, np.diff(t) > 0) if len(t) else finite[:0]
    return t[keep], y[keep]
