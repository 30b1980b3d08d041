"""Progress of long computations: stage, time taken and left; partial results on Ctrl-C."""

from __future__ import annotations

import signal
import threading
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


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Raise KeyboardInterrupt in the block once it takes this long [s].

    In the main thread, where the system has timers; elsewhere the block has all the time it takes.
    """
    here = threading.current_thread() is threading.main_thread()
    if not (here and hasattr(signal, "setitimer")):
        yield
        return

    def over(*_: object) -> None:
        raise KeyboardInterrupt

    before, began = signal.signal(signal.SIGALRM, over), time.monotonic()
    left, again = signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        if left:  # somebody else's timer goes on
            rest = max(left - (time.monotonic() - began), 1e-3)
            signal.setitimer(signal.ITIMER_REAL, rest, again)


@dataclass
class Stages:
    """Reports each stage with the time taken, and the most time that may be left.

    How many stages follow is not known: whether a diagnosis looks for one more effect depends on
    what the last one left. But a stage begins when at least a known share of the whole is done. So
    the most time that may be left is told, once `SEEN` of the whole is surely done; it is no bound
    if the whole is open-ended.

    Args:
        tell: shows a line; None for no output.
        done: the least share of the whole that is done when a stage begins for the k-th time.
        open_ended: whether what is found may ask for more stages than those shares were learnt on.
    """

    tell: Callable[[str], None] | None
    done: Callable[[str, int], float]
    open_ended: bool = False
    began: float = field(default_factory=time.monotonic)
    so_far: str = "nothing was found yet"  # the result so far, for Ctrl-C
    beside: str = ""  # what all further stages are for
    begun: dict[str, int] = field(default_factory=dict)  # how often each stage began
    last: str = ""  # the stage of the last call
    end: float | None = None  # the latest end that was told, seconds after the start

    def __call__(self, stage: str, part: str = "") -> None:
        """Report that a stage, or a part of it (`, round 2 of at most 8`), begins or continues."""
        taken = time.monotonic() - self.began
        if stage + part != self.last:
            self.begun[stage], self.last = self.begun.get(stage, 0) + 1, stage + part
            share = self.done(stage, self.begun[stage])
            self.end = taken / share if share >= SEEN else self.end
        if self.tell is None:
            return
        text = f"{stage}{part}{f' ({self.beside})' * bool(self.beside)}, {duration(taken)} so far"
        if self.end is not None and (left := _round(self.end - taken)) > 0:
            most, more = ("", ", more if more is found") if self.open_ended else ("up to ", "")
            text += f", {most}about {duration(left).replace('.0 ', ' ')} left{more}"
        self.tell(text)


SEEN = 0.05


def _round(seconds: float) -> float:
    """Return a duration in one significant digit below 100 s, else in whole minutes."""
    return float(f"{seconds:.1g}") if seconds < 100 else 60 * round(seconds / 60)


def duration(seconds: float) -> str:
    """Format a duration: 40 s, 2.5 min, 12 min."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 600 else f"{seconds / 60:.0f} min"
