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
    diagnosis looks for one more effect depends on what the last one left. So the time left is told
    as a range, and not at all after more calls than most computations take.

    Args:
        tell: shows a line; None for no output.
        usual: fewest and most calls of most computations of this kind.
    """

    tell: Callable[[str], None] | None
    usual: tuple[int, int]
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
        if SEEN < self.count <= self.usual[1]:  # beyond, nothing is known of what is left
            least, most = (taken * (n / self.count - 1) for n in self.usual)
            text += f", {_range(max(least, 0.0), most)} left"
        self.tell(text)


SEEN = 10  # calls from which on the time left is told


def _range(least: float, most: float) -> str:
    """Format a range of durations: `about 10 s to 2 min`, `up to about 40 s`."""
    low, high = (duration(_round(end)).replace(".0 ", " ") for end in (least, most))
    if low == high or most < NOW:
        return f"about {high}"
    return f"up to about {high}" if least < NOW else f"about {low} to {high}"


NOW = 1.0  # [s] durations below it are not told


def _round(seconds: float) -> float:
    """Return a duration in one significant digit below 100 s, else in whole minutes."""
    return float(f"{seconds:.1g}") if seconds < 100 else 60 * round(seconds / 60)


def duration(seconds: float) -> str:
    """Format a duration: 40 s, 2.5 min, 12 min."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 600 else f"{seconds / 60:.0f} min"
