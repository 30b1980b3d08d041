"""What was seen in a log, as values, and what a person should know before using it.

Signals of different topics that show the same motion, and those that show it with another sign.

A motion capture's pitch and the on-board estimate's should rise together; where they rise
opposite, one of them follows another convention, and a log that mixes them is wrong.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np

from grounded_trials.formats.messages import Floats, Ints

GAP = 10.0  # intervals; a longer gap is remarked on
SKEW_S = 0.1  # a header stamp further from the log's clock is remarked on


@dataclass(frozen=True)
class FieldReport:
    """A number in a topic's messages, by its message path."""

    path: str
    low: float | None  # smallest and largest finite value; None if there is none
    high: float | None
    not_finite: int
    noise: float = 0.0  # standard deviation of what changes from sample to sample


@dataclass(frozen=True)
class TopicReport:
    """A topic: how its messages come, and what is in them."""

    topic: str
    type: str
    encoding: str
    messages: int
    rate_hz: float  # 1 / median interval of the log times; 0 for fewer than two messages
    jitter_s: float  # half the width that holds 90 % of the intervals
    largest_gap_s: float
    first_s: float | None  # after the log's first message; None without messages
    last_s: float | None
    stamped: bool  # messages have a header stamp
    skew_s: float | None  # median of header stamp minus log time
    fields: tuple[FieldReport, ...]
    problem: str = ""  # why its numbers can't be read


@dataclass(frozen=True)
class LogReport:
    """A log: its files, its length, its topics, and whether it is damaged."""

    files: tuple[Path, ...]
    library: str  # who wrote it
    start_ns: int
    duration_s: float
    messages: int
    topics: tuple[TopicReport, ...]
    twins: tuple[Twins, ...]  # signals of different topics with one motion
    damage: str = ""  # where reading it ended early, and why
    meta: Mapping[str, str] = field(default_factory=dict)  # of a file of ours: its own table

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences about what a person should know before using the log."""
        return _remarks(self)


def _remarks(log: LogReport) -> tuple[str, ...]:
    found = [log.damage] if log.damage else []
    for topic in log.topics:
        if topic.problem:
            found.append(f"{topic.topic} ({topic.type}) can't be read: {topic.problem}")
        if topic.messages == 0:
            found.append(f"{topic.topic} has no messages")
        elif topic.messages == 1:
            found.append(f"{topic.topic} has a single message, {topic.first_s:.3f} s into the log")
        elif topic.rate_hz and topic.largest_gap_s > GAP / topic.rate_hz:
            found.append(f"{topic.topic} has a gap of {topic.largest_gap_s:.3f} s")
        if topic.skew_s is not None and abs(topic.skew_s) > SKEW_S:
            found.append(
                f"{topic.topic} is stamped {topic.skew_s:.3f} s from the log's clock "
                "(simulation time, or an unset clock?)"
            )
        bad = [f.path for f in topic.fields if f.not_finite]
        if bad:
            found.append(f"{topic.topic} has values that are no numbers, first in {bad[0]}")
    for twins in log.twins:
        if twins.opposite:
            found.append(
                f"{twins.first} and {twins.second} show the same motion with OPPOSITE SIGN "
                f"(correlation {twins.correlation:.3f})"
            )
    return tuple(found)


SAME = 0.95  # correlation from which two signals show the same motion
LEAST = 30  # samples
KINDS = (
    *(f"@rpy.{angle}" for angle in ("roll", "pitch", "yaw")),
    *(f"{place}.{axis}" for place in ("position", "translation") for axis in "xyz"),
    *(f"{rate}.{axis}" for rate in ("linear", "angular") for axis in "xyz"),
)


@dataclass(frozen=True)
class Twins:
    """Two signals with one motion; a negative correlation says that a sign differs."""

    first: str  # message paths
    second: str
    correlation: float

    @property
    def opposite(self) -> bool:
        """Whether one of them has the other's sign reversed."""
        return self.correlation < 0


def kind_of(path: str) -> str:
    """What a path measures, such as position.x; "" if that can't be told from its name."""
    return next((kind for kind in KINDS if path.endswith("." + kind)), "")


def find_twins(samples: Mapping[str, tuple[Ints, Floats]]) -> tuple[Twins, ...]:
    """Compares signals of the same kind.

    Args:
        samples: by message path, stamps [ns] and values.
    """
    found = []
    for first, second in combinations(samples, 2):
        if kind_of(first) == kind_of(second) != "":
            correlation = _correlation(samples[first], samples[second])
            if abs(correlation) >= SAME:
                found.append(Twins(first, second, correlation))
    return tuple(found)


def _correlation(a: tuple[Ints, Floats], b: tuple[Ints, Floats]) -> float:
    """Of the rarer signal with the other at its stamps."""
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
