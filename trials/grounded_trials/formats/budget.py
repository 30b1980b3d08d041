"""What reading one log may cost: CPU time and memory, in proportion to the size of its files.

A few kilobytes can ask for gigabytes (compressed zeros, nested lists of JSON) or for hours (a
hundred thousand lists that are stepped over one by one). No single limit of a record or a list
stops that: they add up. So whoever reads a log opens a `budget` for all of it, and what decodes
says what it is about to do: `step` at every turn that may be one of very many, `room` before memory
is taken and given back, `keep` for what stays until the log is read.

Outside a budget these do nothing. The time is the CPU's, of the thread that reads: a slow disk or
a busy machine refuse nothing.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from time import thread_time

from grounded.errors import GroundedError

MB = 10**6
SECONDS, MEMORY = "GROUNDED_FILE_SECONDS", "GROUNDED_FILE_MB"
DEFAULTS = {SECONDS: 3.0, MEMORY: 250.0}  # [s], [MB], of an empty file
SECONDS_PER_MB, MEMORY_PER_BYTE = 1.0, 8.0  # more for each MB, and for each byte, of the file


class OverBudget(GroundedError):
    """Reading a file takes more time or memory than its size explains."""


class _Budget:
    def __init__(self, name: str, size: int) -> None:
        self.name, self.size, self.kept = name, size, 0
        self.seconds = _setting(SECONDS) + SECONDS_PER_MB * size / MB
        self.memory = _setting(MEMORY) * MB + MEMORY_PER_BYTE * size
        self.end = thread_time() + self.seconds

    def over(self, what: str, setting: str) -> OverBudget:
        return OverBudget(
            f"{self.name}: reading its {_size(self.size)} takes more than {what}: it is damaged or "
            f"made to do harm. If you trust it, set {setting} (now {_setting(setting):g}) higher"
        )


_NOW: ContextVar[_Budget | None] = ContextVar("budget", default=None)


@contextmanager
def budget(name: str, files: Iterable[Path] | int) -> Iterator[None]:
    """What is decoded inside may cost as much as these files explain, all together.

    Args:
        name: of the log, for the message.
        files: the log's files, or their size [bytes].

    Raises:
        OverBudget: from inside, where more is asked for.
        GroundedError: for a setting in the environment that is not a positive number.
    """
    size = files if isinstance(files, int) else sum(file.stat().st_size for file in files)
    token = _NOW.set(_Budget(name, size))
    try:
        yield
    except MemoryError:
        raise _Budget(name, size).over("the memory that there is", MEMORY) from None
    finally:
        _NOW.reset(token)


def step() -> None:
    """Refuses to go on when the time is used up."""
    now = _NOW.get()
    if now is not None and thread_time() > now.end:
        raise now.over(f"{now.seconds:.1f} s of CPU time", SECONDS)


def room(count: float) -> None:
    """Refuses to take `count` bytes beside what is kept, and to go on when time is used up."""
    now = _NOW.get()
    if now is not None and now.kept + count > now.memory:
        raise now.over(f"{now.memory / MB:.0f} MB of memory", MEMORY)
    step()


def keep(count: int) -> None:
    """Takes `count` bytes until the log is read."""
    room(count)
    now = _NOW.get()
    if now is not None:
        now.kept += count


def _setting(name: str) -> float:
    text = os.environ.get(name) or str(DEFAULTS[name])
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not value > 0:
        raise GroundedError(f"{name} is '{text[:40]}'; expected a positive number")
    return value


def _size(count: int) -> str:
    return f"{count / MB:.1f} MB" if count >= MB else f"{count} bytes"
