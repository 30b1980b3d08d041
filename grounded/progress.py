"""Progress of long computations: stage and time taken; partial results on Ctrl-C."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


class Interrupted(KeyboardInterrupt):
    """Raised on Ctrl-C; its text is the result so far."""


@contextmanager
def interruptible(so_far: Callable[[], str]) -> Iterator[None]:
    """Turn Ctrl-C into `Interrupted` with the result so far, which is asked for only then."""
    try:
        yield
    except Interrupted:
        raise
    except KeyboardInterrupt:
        raise Interrupted(so_far()) from None


@dataclass
class Stages:
    """Reports each stage with the time taken.

    The time left is not known to within a factor of two before the end: whether a diagnosis looks
    for one more effect depends on what the last one left.

    Args:
        tell: shows a line; None for no output.
    """

    tell: Callable[[str], None] | None
    began: float = field(default_factory=time.monotonic)
    so_far: str = "nothing was found yet"  # the result so far, for Ctrl-C
    beside: str = ""  # what all further stages are for

    def __call__(self, stage: str) -> None:
        """Report that a stage begins or continues."""
        if self.tell is not None:
            taken = duration(time.monotonic() - self.began)
            self.tell(f"{stage}{f' ({self.beside})' * bool(self.beside)}, {taken} so far")


def duration(seconds: float) -> str:
    """Format a duration: 40 s, 2.5 min, 12 min."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 600 else f"{seconds / 60:.0f} min"
