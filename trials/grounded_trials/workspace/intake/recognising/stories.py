"""A story of how the log of a candidate's run came about, and what it leaves unexplained.

Every story is scored by the same terms, in nats: what it leaves of the commands, given the policy
and what the policy was fed; how far the robot is then from its prediction; and what the story costs
before a log is seen. Whether the log, the program or the robot is at fault follows from what
remains: a log that is read otherwise must be as predicted, a program's run need not be.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from math import log
from typing import Any

from grounded.findings import Finding
from grounded.search.candidate import Candidate
from grounded.search.returned.as_predicted import apart
from grounded.search.returned.who_drove import FINE
from grounded.trial import Trial

CLEAR = 1.0  # [nats] by which a story must explain a log better than the log as it is


class Kind(Enum):
    """What a story is about, which decides how it is told."""

    UNIT = "columns of the log times a factor"
    LOG = "another fault of the log"
    PROGRAM = "the program misused its candidate"
    ROBOT = "the robot acted otherwise than it was told"
    FELL = "the run failed before the log ends"
    CANDIDATE = "another candidate ran"
    EARLIER = "a candidate of an earlier task ran"
    UNKNOWN = "as logged, which is no run of the candidate"


@dataclass(frozen=True)
class Story:
    """One story of how a log came about.

    Args:
        kind: what it is about.
        finding: what it is, and what to do about it; None for columns times a factor.
        commands: what it leaves of the commands [nats], the logarithm of their relative error.
        motion: how far the robot is from its prediction then [nats].
        price: what it costs before a log is seen [nats].
        rerun: no setting reads this log: the next run, or another log of this one, is needed.
        names: columns that have to be multiplied.
        by: the factor.
    """

    kind: Kind
    finding: Finding | None = None
    commands: float = 0.0
    motion: float = 0.0
    price: float = 0.0
    rerun: bool = False
    names: tuple[str, ...] = ()
    by: float = 1.0

    @property
    def left(self) -> float:
        """What remains unexplained [nats]."""
        return self.commands + self.motion + self.price


def scored(
    kind: Kind, finding: Finding | None, own: Candidate, run: Trial, error: float, **other: Any
) -> Story:
    """Return a story with its score.

    Args:
        kind: what it is about.
        finding: what to tell of it.
        own: the candidate whose commands these are.
        run: the trial as it was by the story.
        error: what is left of the commands, relative to their size.
        other: further fields of `Story`.
    """
    return Story(kind, finding, log(error + FINE), apart(own, run), **other)


def likeliest(stories: Iterable[Story | None], as_logged: Story) -> Story:
    """Return the story that explains a log best; `as_logged` unless one leads it clearly."""
    some = [one for one in stories if one and one.left < as_logged.left - CLEAR]
    return min(some, key=lambda one: one.left, default=as_logged)
