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

    Args:
        tell: shows a line; None: nobody listens.
        usual: calls until the end; where there are more, the end recedes.
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
        share = self.count / max(self.usual, 1.1 * self.count)
        left = (time.monotonic() - self.began) * (1 - share) / share
        shrinks, self.left = left < self.left, left  # where the end recedes, nobody knows when
        about = f", about {left:.0f} s left" if self.count > 10 and shrinks else ""
        self.tell(f"{stage}, {100 * share:.0f} % done{about}")
