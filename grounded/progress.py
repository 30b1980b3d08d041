"""Progress of long computations: stage, time taken and left; partial results on Ctrl-C."""

from __future__ import annotations

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
    """Reports each stage with the time taken and the time that is left, from the number of calls.

    The number of calls is known within wide limits only: it grows with the data, and whether a
    diagnosis looks for one more effect depends on what the last one left. So only the most time
    that may be left is told, and none after more calls than most computations take.

    Args:
        tell: shows a line; None for no output.
        most: the number of calls that few computations of this kind exceed.
    """

    tell: Callable[[str], None] | None
    most: int
    began: float = field(default_factory=time.monotonic)
    count: int = 0
    so_far: str = "nothing was found yet"  # the result so far, for Ctrl-C
    beside: str = ""  # what all further stages are for

    def __call__(self, stage: str) -> None:
        """Report that a stage begins or continues."""
        self.count += 1
        if self.tell is None:
            return
        taken = time.monotonic() - self.began
        text = f"{stage}{f' ({self.beside})' * bool(self.beside)}, {duration(taken)} so far"
        if SEEN < self.count <= self.most:  # beyond, nothing is known of what is left
            left = _round(taken * (self.most / self.count - 1))
            text += f", up to about {duration(left).replace('.0 ', ' ')} left" * (left > 0)
        self.tell(text)


SEEN = 10  # calls from which on the time left is told


def _round(seconds: float) -> float:
    """Return a duration in one significant digit below 100 s, else in whole minutes."""
    return float(f"{seconds:.1g}") if seconds < 100 else 60 * round(seconds / 60)


def duration(seconds: float) -> str:
    """Format a duration: 40 s, 2.5 min, 12 min."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 600 else f"{seconds / 60:.0f} min"
