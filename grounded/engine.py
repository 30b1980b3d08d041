"""Engine: where independent pieces of work run. Results do not depend on the number of workers.

The jobs of a study are processes of their own (`processes`). The pieces of one computation (`each`:
records of a fit, hypotheses of a diagnosis) are short, numerous and share their data. On Linux they
run in copies of this process (`forked`). Elsewhere, and where they step a simulator, which may have
threads or connections that a copy lacks, they run in threads.

All use one BLAS thread and keep freed memory (`steady`). The matrices are small, so OpenBLAS's own
threads wait for each other (three times the CPU of a diagnosis on two busy cores) and change the
order of summation. The arrays are large enough that the C library returns each to the system,
which then clears every page of the next one: 40 % of the time of a diagnosis.
"""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from contextlib import ExitStack, closing, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing import get_context
from typing import Any, TypeVar

import numpy as np

from grounded.checks import wrong
from grounded.forked import Forks, possible

STACK = 16 * 2**20  # [bytes] stack size of a thread: kernels keep their matrices there
TRIM, MAP = -1, -3  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD of the GNU C library
REUSED_BYTES = 2**28  # [bytes] freed blocks up to this size are reused
T = TypeVar("T")


@contextmanager
def steady() -> Iterator[None]:
    """Use one BLAS thread and keep freed memory; also a decorator, `@steady()`."""
    import scipy.linalg  # noqa: F401  loads SciPy's own BLAS, so that it is limited as well
    from threadpoolctl import threadpool_limits

    _keep_pages()
    with threadpool_limits(1, user_api="blas"):
        yield


@cache
def _keep_pages() -> None:
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # not the GNU C library
        return
    mallopt(MAP, REUSED_BYTES)
    mallopt(TRIM, REUSED_BYTES)


def cores() -> int:
    """Return the number of processors that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except (AttributeError, OSError):  # not Linux
        return os.cpu_count() or 1


@dataclass(frozen=True)
class Engine:
    """Workers on this machine: processes, copies or threads; 1 runs everything in this process.

    Raises:
        GroundedError: if `jobs` is below 1.
    """

    jobs: int = 1

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise wrong("--jobs", self.jobs, must="whole", low=1)


def processes(engine: Engine, function: Callable[[Any], T], rows: Sequence[Any]) -> Iterator[T]:
    """Yield function(row) of all rows as they are found, in any order.

    The function is one of a module; it, its arguments and results must be picklable. A process that
    ends by itself raises BrokenProcessPool.
    """
    if engine.jobs == 1:
        yield from map(function, rows)
        return
    pool = ProcessPoolExecutor(engine.jobs, get_context("spawn"))
    try:
        for done in as_completed([pool.submit(_steadily, function, (row,)) for row in rows]):
            yield done.result()
    finally:
        pool.shutdown(cancel_futures=True)


Results = Generator[tuple[int, Any], None, None]  # index of a piece, its result
Call = Callable[[Any, Sequence[Any]], Results]  # of a function and the rows of its arguments
_pool: ContextVar[Call | None] = ContextVar("pool", default=None)


@contextmanager
def running(engine: Engine | None, *, copied: bool = True) -> Iterator[None]:
    """Make `each` use this engine inside the block; None: run in this process.

    Pieces that step a simulator must not run in copies of this process (`copied`).
    """
    if engine is None or engine.jobs == 1:
        yield
        return
    with ExitStack() as stack:
        call: Call
        if copied and possible():
            call = Forks(engine.jobs, (Shared,))
        else:
            stack.callback(threading.stack_size, threading.stack_size(STACK))
            threads = stack.enter_context(ThreadPoolExecutor(engine.jobs))
            call = partial(_threaded, threads)
        before = _pool.set(call)
        try:
            yield
        finally:
            _pool.reset(before)


def _alone(function: Any, rows: Sequence[Any]) -> Results:
    yield from ((k, function(*row)) for k, row in enumerate(rows))


def _threaded(threads: Executor, function: Any, rows: Sequence[Any]) -> Results:
    """Yield the results of threads; if it is ended early, end the pieces that they are at."""
    at_work = set[int]()

    def piece(row: Any) -> Any:
        at_work.add(threading.get_ident())
        try:
            return _quietly(function, row)
        finally:
            at_work.discard(threading.get_ident())

    pieces = [threads.submit(piece, row) for row in rows]
    try:
        yield from ((k, one.result()) for k, one in enumerate(pieces))
    finally:
        for one in pieces:
            one.cancel()
        for thread in tuple(at_work):  # at its next line of Python
            ended = ctypes.py_object(KeyboardInterrupt)
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), ended)


def each(
    function: Callable[..., T], *columns: Sequence[Any], done: Callable[[], None] | None = None
) -> list[T]:
    """Return [function(*row) for row in zip(*columns)], computed on the engine of `running`.

    The function must not modify shared data; `done` is called after each piece.
    """
    rows, results = list(zip(*columns, strict=True)), dict[int, T]()
    call = (_pool.get() if len(rows) > 1 else None) or _alone
    with closing(call(function, rows)) as found:  # ends what was begun, if one piece raises
        for k, result in found:
            results[k] = result
            if done is not None:
                done()
    return [results[k] for k in range(len(rows))]


def _quietly(function: Callable[..., T], row: Sequence[Any]) -> T:
    with np.errstate(all="ignore"):  # workers do not inherit this setting
        return function(*row)


@steady()
def _steadily(function: Callable[..., T], row: Sequence[Any]) -> T:
    return _quietly(function, row)


class Shared:
    """Base class of data that many pieces read, of which no result contains a part."""
