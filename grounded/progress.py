"""Long computations talk: stage, share done, time left; and what was found so far on Ctrl-C."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, with the answer so far as its text."""


@contextmanager
def interruptible(so_far: Callable[[], str]) -> Iterator[None]:
    """Turns Ctrl-C into `Interrupted`, with what had been found by then.

    Args:
        so_far: says it; called only then.
    """
    try:
        yield
    except Interrupted:
        raise
    except KeyboardInterrupt:
        raise Interrupted(so_far()) from None


@dataclass
class Stages:
    """Adds to each stage's name the share done and the time left, from how many are usual.

    Where nearly as many are done and it goes on, nobody knows when it ends: the time taken so far.

    Args:
        tell: shows a line; None: nobody listens.
        usual: calls until the end.
    """

    tell: Callable[[str], None] | None
    usual: int
    began: float = field(default_factory=time.monotonic)
    count: int = 0
    left: float = math.inf  # seconds, as last guessed
    so_far: str = "nothing was found yet"  # the answer, for Ctrl-C

    def __call__(self, stage: str) -> None:
        """A stage begins, or goes on."""
        self.count += 1
        if self.tell is None:
            return
        share, taken = self.count / self.usual, time.monotonic() - self.began
        if share > NEARLY:
            return self.tell(f"{stage}, longer than usual, {_told(taken)} so far")
        left = taken * (1 - share) / share
        shrinks, self.left = left < self.left, left  # where the end recedes, nobody knows when
        about = f", about {_told(left)} left" if self.count > 10 and shrinks else ""
        self.tell(f"{stage}, {100 * share:.0f} % done{about}")


NEARLY = 0.9  # of what is usual: what is left then may be as long again


def _told(seconds: float) -> str:
    """A time as a person says it: 40 s, 7 min."""
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
