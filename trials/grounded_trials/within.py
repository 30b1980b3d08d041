"""Read a log in a child process, whose time, memory and files are limited by the size of the log.

A file of a few kilobytes can require gigabytes (compressed zeros, nested JSON lists) or hours (a
hundred thousand lists that must be skipped one by one), in our code or in a library that decodes
it. `within` therefore runs whatever reads a log in a child process that the system ends at a limit,
so that no loop has to count what it does. The child returns its result, or its exception.

The child is a copy of this process (a fork): it starts in a few milliseconds, and what it is given
need not be picklable. Time is its CPU time, so a slow disk or a busy machine does not matter.
Forks are safe on Linux alone; elsewhere logs are read in this process, without a budget.
"""

from __future__ import annotations

import gc
import os
import pickle
import select
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from errno import EFBIG
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from grounded.checks import wrong
from grounded.errors import GroundedError
from grounded_trials.plain_file import unreadable

P = ParamSpec("P")
T = TypeVar("T")
MB = 10**6
SECONDS, MEMORY = "GROUNDED_FILE_SECONDS", "GROUNDED_FILE_MB"
DEFAULTS = {SECONDS: 3.0, MEMORY: 250.0}  # [s], [MB], for an empty file
SECONDS_PER_MB, MEMORY_PER_BYTE = 1.0, 8.0  # in addition, for each MB and byte of the file
DISK = 4  # [memory] largest decompressed file
PATIENCE = 20  # [CPU time] after which a child that does not end is stuck
ENDS = {77: "memory", 78: "disk", -9: "memory", -27: "time"}  # exit codes; SIGKILL, SIGPROF
FORKS = sys.platform == "linux" and hasattr(os, "fork")

_inside = False  # whether this process is such a child


class OverBudget(GroundedError):
    """Reading a file takes more time or memory than its size justifies."""


@dataclass(frozen=True)
class _Limits:
    name: str
    size: int  # [bytes]

    @property
    def seconds(self) -> float:
        return _setting(SECONDS) + SECONDS_PER_MB * self.size / MB

    @property
    def memory(self) -> int:
        return int(_setting(MEMORY) * MB + MEMORY_PER_BYTE * self.size)

    def over(self, what: str) -> GroundedError:
        """Return the error for a child that ended at a limit, or for another reason."""
        texts = {
            "time": (f"{self.seconds:.1f} s of CPU time", SECONDS),
            "memory": (f"{self.memory / MB:.0f} MB of memory", MEMORY),
            "disk": (f"{DISK * self.memory / MB:.0f} MB on the disk", MEMORY),
        }
        size = f"{self.size / MB:.1f} MB" if self.size >= MB else f"{self.size} bytes"
        if what not in texts:
            return OverBudget(f"{self.name}: reading its {size} {what}: the file seems damaged")
        text, setting = texts[what]
        return OverBudget(
            f"{self.name}: reading its {size} takes more than {text}: it is damaged or malicious. "
            f"If you trust it, increase {setting} (now {_setting(setting):g})"
        )


def within(
    name: str | Path, size: int, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs
) -> T:
    """Return function(...), computed in a child process with limits for a file of `size` bytes.

    What it returns is pickled, and what it modifies stays unmodified here. Files that it writes to
    the temporary folder are deleted. `name` is that of the log, for the message.
    """
    if _inside or not FORKS:
        return function(*args, **kwargs)
    limits = _Limits(str(name), size)
    with tempfile.TemporaryDirectory(prefix="grounded-") as room:
        receive, send = os.pipe()
        try:
            with warnings.catch_warnings():  # of other threads, whose locks no reader takes
                warnings.simplefilter("ignore", DeprecationWarning)
                child = os.fork()
        except OSError as error:
            raise unreadable(name, error) from None
        if not child:
            try:
                os.close(receive)
                gc.freeze()  # else the first collection copies the parent's memory
                with os.fdopen(send, "wb") as out:
                    _serve(out, limits, room, lambda: function(*args, **kwargs))
            finally:
                os._exit(1)
        os.close(send)
        ended: int | None = None
        with os.fdopen(receive, "rb") as answer:
            try:
                found = _answer(answer, limits)
            finally:  # also of Ctrl-C
                with suppress(OSError):  # the program that this runs in may have waited
                    os.kill(child, signal.SIGKILL)  # that changes no exit code of what has ended
                    ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if found is None:
        raise limits.over(ENDS.get(ended or 0) or f"crashes (exit code {ended})")
    done, value = found
    if not done:
        raise value
    result: T = value
    return result


def _answer(answer: Any, limits: _Limits) -> tuple[bool, Any] | None:
    """Return what the child sent: whether it succeeded, and its result or exception.

    None if it ended before, or while it answered.
    """
    patience = PATIENCE * limits.seconds
    waiting = select.poll()
    waiting.register(answer, select.POLLIN)
    if not waiting.poll(1e3 * patience):
        return False, limits.over(f"does not end within {patience:.0f} s")
    try:
        found: tuple[bool, Any] = pickle.load(answer)
    except (EOFError, pickle.UnpicklingError):
        return None
    return found


def _serve(out: Any, limits: _Limits, room: str, function: Callable[[], Any]) -> None:
    """Set the limits, call the function, send its result or exception, and end the process."""
    global _inside
    _inside, tempfile.tempdir, code = True, room, 0
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends it through its parent
    try:
        _limit(limits.seconds, limits.memory)
        pickle.dump((True, function()), out, pickle.HIGHEST_PROTOCOL)
        out.flush()
    except BaseException as error:
        code = _cause(error)
        if not code:
            error.__traceback__, text = None, traceback.format_exc()
            out.write(_pickled(error, text))
            out.flush()
    os._exit(code)


def _limit(seconds: float, memory: int) -> None:
    """Let the system end this process at its limits."""
    import resource  # Windows has none

    signal.signal(signal.SIGPROF, signal.SIG_DFL)  # ends it, also inside a library
    signal.setitimer(signal.ITIMER_PROF, seconds)
    limits = {resource.RLIMIT_FSIZE: DISK * memory}
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limits[resource.RLIMIT_AS] = pages * resource.getpagesize() + memory
    for kind, most in limits.items():
        hard = resource.getrlimit(kind)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (most, hard))


def _cause(error: BaseException | None) -> int:
    """Return the exit code of the limit that led to an exception; 0 for any other."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        if isinstance(error, MemoryError):
            return 77
        if isinstance(error, OSError) and error.errno == EFBIG:
            return 78
        error = error.__cause__ or error.__context__
    return 0


def _pickled(error: BaseException, text: str) -> bytes:
    """Return an answer with an exception; with its traceback unless it is meant for the user."""
    if not isinstance(error, GroundedError):
        error.add_note(text)
    try:
        answer = pickle.dumps((False, error))
        pickle.loads(answer)
    except Exception:  # an exception of a library that can't be pickled
        answer = pickle.dumps((False, RuntimeError(text)))
    return answer


def _setting(name: str) -> float:
    text = os.environ.get(name) or str(DEFAULTS[name])
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not value > 0:
        raise wrong(name, text[:40], must="positive")
    return value
