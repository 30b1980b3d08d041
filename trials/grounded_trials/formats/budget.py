"""Limits on reading one log: CPU time and memory, in proportion to the size of its files.

A file of a few kilobytes can require gigabytes (compressed zeros, nested JSON lists) or hours (a
hundred thousand lists that must be skipped one by one). Limits on single records or lists don't
prevent that, since they add up. Readers therefore open a `budget` for a whole log, and decoders
report what they do: `step` in every loop that may be very long, `room` before they allocate memory
temporarily, `keep` for memory that stays in use until the log is read.

Outside a budget these functions do nothing. Time is the CPU time of the reading thread, so a slow
disk or a busy machine does not matter.
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
DEFAULTS = {SECONDS: 3.0, MEMORY: 250.0}  # [s], [MB], for an empty file
SECONDS_PER_MB, MEMORY_PER_BYTE = 1.0, 8.0  # in addition, for each MB and byte of the file


class OverBudget(GroundedError):
    """Reading a file takes more time or memory than its size justifies."""


class _Budget:
    def __init__(self, name: str, size: int) -> None:
        self.name, self.size, self.kept = name, size, 0
        self.seconds = _setting(SECONDS) + SECONDS_PER_MB * size / MB
        self.memory = _setting(MEMORY) * MB + MEMORY_PER_BYTE * size
        self.end = thread_time() + self.seconds

    def over(self, what: str, setting: str) -> OverBudget:
        return OverBudget(
            f"{self.name}: reading its {_size(self.size)} takes more than {what}: it is damaged or "
            f"malicious. If you trust it, increase {setting} (now {_setting(setting):g})"
        )


_NOW: ContextVar[_Budget | None] = ContextVar("budget", default=None)


@contextmanager
def budget(name: str, files: Iterable[Path] | int) -> Iterator[None]:
    """Limit the time and memory of everything decoded in the context, by the size of the files.

    Args:
        name: of the log, for the message.
        files: the log's files, or their size [bytes].

    Raises:
        OverBudget: raised inside the context when a limit is exceeded.
        GroundedError: for a setting in the environment that is not a positive number.
    """
    size = files if isinstance(files, int) else sum(file.stat().st_size for file in files)
    token = _NOW.set(_Budget(name, size))
    try:
        yield
    except MemoryError:
        raise _Budget(name, size).over("the available memory", MEMORY) from None
    finally:
        _NOW.reset(token)


def step() -> None:
    """Raise an error if the time is used up."""
    now = _NOW.get()
    if now is not None and thread_time() > now.end:
        raise now.over(f"{now.seconds:.1f} s of CPU time", SECONDS)


def room(count: float) -> None:
    """Raise an error if `count` more bytes exceed the memory, or if the time is used up."""
    now = _NOW.get()
    if now is not None and now.kept + count > now.memory:
        raise now.over(f"{now.memory / MB:.0f} MB of memory", MEMORY)
    step()


def keep(count: int) -> None:
    """Account for `count` bytes that stay in use until the log is read."""
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
