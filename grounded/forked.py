"""Copies of this process (forks) that compute the pieces of one computation.

A fit spends most of its time in short NumPy calls, which hold the GIL: two threads are no faster
than one. A copy of the process has the data, the models and their compiled code already, so that
only results are sent, through a pipe. What the pieces were given (models, effects, data) is sent
back by reference: it need not be picklable, and stays the same object. A piece must not modify it.

To make a copy takes some 10 ms, so short pieces are computed here, and how long a piece takes is
measured. What a copy does not return (it failed, was killed, or waits for a lock that a thread
held when it was made) is computed here as well, where an exception is raised as without copies.

Linux only: system libraries of macOS are unsafe in a copy, and Windows has none.
"""

from __future__ import annotations

import contextlib
import gc
import io
import os
import pickle
import select
import signal
import sys
import time
import warnings
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

WORTH_S = 0.03  # [s] least time of the pieces of a copy
WIDTH = 4  # [bytes] of an index in the queue
QUEUE_PIECES = 8192  # pieces whose indices the queue holds
PATIENCE_S, PATIENCE = 5.0, 10.0  # a copy gets this, or this times the longest piece, to answer
PLAIN = (int, float, complex, bool, str, bytes, type(None), np.generic)  # sent as they are


def possible() -> bool:
    """Return whether copies of this process can be made."""
    return sys.platform == "linux" and hasattr(os, "fork")


@dataclass
class Forks:
    """Compute pieces in up to `jobs` processes, this one included.

    Args:
        jobs: number of processes.
        whole: types of data that pieces read; no result contains a part of one.
    """

    jobs: int
    whole: tuple[type, ...] = ()
    _took: dict[Any, float] = field(default_factory=dict)  # [s] the latest piece of each function

    def __call__(
        self, function: Callable[..., Any], rows: Sequence[Any]
    ) -> Generator[tuple[int, Any], None, None]:
        """Yield (k, function(*rows[k])) for all k, as they are found."""
        left = dict(enumerate(rows))
        if function not in self._took:
            yield 0, self._here(function, left.pop(0))
        worth = int(len(left) * self._took[function] / WORTH_S)
        copies = min(self.jobs, len(left), worth) - 1
        if copies > 0 and len(left) <= QUEUE_PIECES:
            yield from self._shared(function, left, copies)
        for k, row in left.items():
            yield k, self._here(function, row)

    def _here(self, function: Callable[..., Any], row: Sequence[Any]) -> Any:
        began = time.perf_counter()
        result = function(*row)
        self._took[function] = time.perf_counter() - began
        return result

    def _shared(
        self, function: Callable[..., Any], left: dict[int, Any], copies: int
    ) -> Generator[tuple[int, Any], None, None]:
        """Yield results computed here and in copies, and take their rows out of `left`."""
        known, longest = _reached(list(left.values()), self.whole), 0.0
        queue, fill = os.pipe()
        os.write(fill, b"".join(k.to_bytes(WIDTH, "little") for k in left))
        os.close(fill)
        children: dict[int, int] = {}  # process id: pipe with its results
        try:
            for _ in range(copies):
                _copied(children, queue, lambda k: _packed((k, function(*left[k])), known))
            while taken := os.read(queue, WIDTH):
                k = int.from_bytes(taken, "little")
                yield k, self._here(function, left.pop(k))
                longest = max(longest, self._took[function])
            until = time.monotonic() + max(PATIENCE_S, PATIENCE * longest)
            for sent in children.values():
                for packed in _received(sent, until):
                    k, result = _Unpickler(packed, known).load()
                    del left[k]
                    yield k, result
        finally:
            os.close(queue)
            for process, sent in children.items():
                os.close(sent)
                with contextlib.suppress(OSError):  # the program that this runs in may have waited
                    os.kill(process, signal.SIGKILL)
                    os.waitpid(process, 0)


def _copied(children: dict[int, int], queue: int, packed: Callable[[int], bytes]) -> None:
    """Make a copy that takes pieces until the queue is empty, and sends the packed results."""
    receive, send = os.pipe()
    try:
        with warnings.catch_warnings():  # of other threads, see the module's docstring
            warnings.simplefilter("ignore", DeprecationWarning)
            process = os.fork()
    except OSError:  # no memory, or too many processes: the pieces are computed here
        os.close(receive)
        os.close(send)
        return
    if process:
        os.close(send)
        children[process] = receive
        return
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C: the parent ends its copies
        gc.disable()  # it would write to every page, which is then copied
        os.close(receive)
        results: list[bytes] = []
        while k := os.read(queue, WIDTH):
            with contextlib.suppress(Exception):
                results.append(packed(int.from_bytes(k, "little")))
        with os.fdopen(send, "wb") as pipe:
            pickle.dump(results, pipe)
    finally:
        os._exit(0)


def _received(sent: int, until: float) -> list[bytes]:
    """Return the packed results of a copy; none if it sends nothing until a time [s]."""
    ready = select.poll()
    ready.register(sent, select.POLLIN)
    if not ready.poll(1e3 * max(0.0, until - time.monotonic())):
        return []
    with os.fdopen(sent, "rb", closefd=False) as pipe, contextlib.suppress(EOFError, ValueError):
        found: list[bytes] = pickle.load(pipe)
        return found
    return []


def _reached(rows: Sequence[Any], whole: tuple[type, ...]) -> dict[int, Any]:
    """Return the objects that pieces are given by their `id`, which copies send instead."""
    found: dict[int, Any] = {}
    with contextlib.suppress(Exception):  # what can't be reached is sent as it is
        _Walker(found, (*whole, np.ndarray)).dump(rows)
    return found


class _Walker(pickle.Pickler):
    def __init__(self, found: dict[int, Any], whole: tuple[type, ...]) -> None:
        super().__init__(io.BytesIO(), pickle.HIGHEST_PROTOCOL)
        self.found, self.whole = found, whole

    def persistent_id(self, thing: Any) -> int | None:
        if isinstance(thing, PLAIN):
            return None
        self.found[id(thing)] = thing
        return 0 if callable(thing) or isinstance(thing, self.whole) else None  # 0: go no deeper


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO, known: dict[int, Any]) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self.known = known

    def persistent_id(self, thing: Any) -> int | None:
        return None if isinstance(thing, PLAIN) or id(thing) not in self.known else id(thing)


class _Unpickler(pickle.Unpickler):
    def __init__(self, packed: bytes, known: dict[int, Any]) -> None:
        super().__init__(io.BytesIO(packed))
        self.known = known

    def persistent_load(self, identity: Any) -> Any:
        return self.known[identity]


def _packed(result: Any, known: dict[int, Any]) -> bytes:
    file = io.BytesIO()
    _Pickler(file, known).dump(result)
    return file.getvalue()
