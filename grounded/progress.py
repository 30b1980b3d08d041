"""Progress of long computations: stage, share done, time left; partial results on Ctrl-C."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


class Interrupted(KeyboardInterrupt):
    """Raised on Ctrl-C; its text is the result so far."""


@contextmanager
def interruptible(so_far: Callable[[], str]) -> Iterator[None]:
    """Turn Ctrl-C into `Interrupted` with the result so far.

    Args:
        so_far: returns that text; called only on Ctrl-C.
    """
    try:
        yield
    except Interrupted:
        raise
    except KeyboardInterrupt:
        raise Interrupted(so_far()) from None


@dataclass
class Stages:
    """Reports each stage with the share done and the time left, from the usual number of calls.

    The number of calls varies by a factor of two either way, and later ones take longer (`LATER`).
    So the time left is told as if there were twice as many calls: "at most".

    Args:
        tell: shows a line; None for no output.
        usual: usual number of calls until the end.
    """

    tell: Callable[[str], None] | None
    usual: int
    began: float = field(default_factory=time.monotonic)
    count: int = 0
    left: float = math.inf  # last estimate of the time left [s]
    so_far: str = "nothing was found yet"  # the result so far, for Ctrl-C

    def __call__(self, stage: str) -> None:
        """Report that a stage begins or continues."""
        self.count += 1
        if self.tell is None:
            return
        taken = time.monotonic() - self.began
        least, share = ((self.count / (by * self.usual)) ** LATER for by in (2.0, 1.0))
        if least > NEARLY:
            return self.tell(f"{stage}, {_told(taken)} so far, longer than usual")
        done = f"about {100 * share:.0f} % done" if share < NEARLY else f"{_told(taken)} so far"
        left = taken * (1 - least) / least
        shrinks, self.left = left < self.left, left  # no estimate is shown if the end recedes
        about = f", at most {_told(left)} left" if self.count > 10 and shrinks else ""
        self.tell(f"{stage}, {done}{about}")


LATER = 1.3  # exponent of the share of calls that gives the share of time (three diagnoses)
NEARLY = 0.9  # share from which on its number says nothing: there may be twice as many calls


def _told(seconds: float) -> str:
    """Format a duration: 40 s, 7 min."""
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
