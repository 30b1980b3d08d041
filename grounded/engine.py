"""Engine: where independent pieces of work run. Results do not depend on the number of workers.

The jobs of a study run through joblib: as processes on this machine (extra `studies`), or as tasks
of an existing Dask cluster through Dask's joblib backend (extra `cluster`). The pieces of one
computation (`each`: records of a fit, hypotheses of a diagnosis) are short, numerous and share
their data. On Linux they run in copies of this process (`forked`). Elsewhere, and where they step a
simulator, which may have threads or connections that a copy lacks, they run in threads. On a
cluster, data that all of them read is sent once (`SentOnce`).

Both use one BLAS thread and keep freed memory (`steady`). The matrices are small, so OpenBLAS's own
threads wait for each other (three times the CPU of a diagnosis on two busy cores) and change the
order of summation. The arrays are large enough that the C library returns each to the system,
which then clears every page of the next one: 40 % of the time of a diagnosis.
"""

from __future__ import annotations

import ctypes
import os
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from grounded.checks import one_of, refused, wrong
from grounded.errors import needs
from grounded.forked import Forks, possible

STACK = 16 * 2**20  # [bytes] stack size of a thread: kernels keep their matrices there
CONNECT_S = 10.0  # [s] timeout for a cluster's scheduler to answer
TRIM, MAP = -1, -3  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD of the GNU C library
LOAD, TASKS = Path("/proc/loadavg"), Path("/proc/self/task")  # runnable threads: all, and these
LOOKS, LOOK_S = 5, 0.002  # that they are counted, and [s] between
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


def idle() -> int:
    """Return the number of processors that nobody else uses now, at least 1; all if unknown."""
    here, busy = cores(), list[int]()
    try:
        for _ in range(LOOKS):
            states = [stat.read_text().rpartition(")")[2] for stat in TASKS.glob("*/stat")]
            mine = sum(state.startswith(" R") for state in states)
            busy.append(int(LOAD.read_text().split()[3].partition("/")[0]) - mine)
            time.sleep(LOOK_S)
    except OSError:  # not Linux
        return here
    return max(1, here - sorted(busy)[LOOKS // 2])


@dataclass(frozen=True)
class Engine:
    """Where independent pieces of work run.

    Args:
        jobs: number of workers on this machine; 1 runs everything in this process.
        name: "local", or "dask" for a running cluster.
        address: address of the cluster's scheduler, such as "tcp://10.0.0.1:8786"; required with
            "dask" only.

    Raises:
        GroundedError: if `jobs` is below 1, `name` is unknown, or `address` does not match `name`.
    """

    jobs: int = 1
    name: str = "local"
    address: str | None = None

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise wrong("--jobs", self.jobs, must="whole", low=1)
        one_of("--engine", self.name, ("local", "dask"))
        if (self.name == "dask") != (self.address is not None):
            pair = ("--engine dask", "--address (tcp://host:8786)")
            raise refused("given.either", *pair, how="both")

    @property
    def alone(self) -> bool:
        """Whether everything runs in this process, one piece after the other."""
        return self.name == "local" and self.jobs == 1

    @contextmanager
    def pool(self, **settings: Any) -> Iterator[Any]:
        """Open a `joblib.Parallel` on these workers; closes the connection, not the cluster.

        Args:
            settings: passed on to `joblib.Parallel`.

        Raises:
            GroundedError: if joblib or Dask is missing, or no scheduler answers.
        """
        joblib = needs("joblib", "studies")
        if self.name == "local":
            # One BLAS thread per worker: results don't depend on how many share the machine.
            here = joblib.parallel_config(backend="loky", inner_max_num_threads=1)
            with here, joblib.Parallel(n_jobs=self.jobs, **settings) as pool:
                yield pool
            return
        distributed = needs("distributed", "cluster")
        try:
            client = distributed.Client(self.address, timeout=CONNECT_S)
        except OSError as error:
            raise refused("file.unreadable", self.address, why=str(error)) from error
        try:
            there = joblib.parallel_config(backend="dask", client=client)
            with there, joblib.Parallel(n_jobs=-1, **settings) as pool:
                yield pool
        finally:
            client.close()


Results = Generator[tuple[int, Any], None, None]  # index of a piece, its result
Call = Callable[[Any, Sequence[Any]], Results]  # of a function and the rows of its arguments
_pool: ContextVar[Call | None] = ContextVar("pool", default=None)


@contextmanager
def running(engine: Engine | None, *, copied: bool = True) -> Iterator[None]:
    """Make `each` use this engine inside the block; None: run in this process.

    Args:
        engine: the workers.
        copied: whether pieces may run in copies of this process; False if they step a simulator.

    Raises:
        GroundedError: as `Engine.pool`.
    """
    if engine is None or engine.alone:
        yield
        return
    with ExitStack() as stack:
        call: Call
        if engine.name == "local" and copied and possible():
            call = Forks(engine.jobs, (SentOnce,))
        elif engine.name == "local":
            stack.callback(threading.stack_size, threading.stack_size(STACK))
            threads = stack.enter_context(ThreadPoolExecutor(engine.jobs))
            call = partial(_threaded, threads)
        else:
            pool = stack.enter_context(engine.pool(batch_size=1, return_as="generator"))
            call = partial(_sent, pool)
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


def _sent(pool: Any, function: Any, rows: Sequence[Any]) -> Results:
    yield from enumerate(pool((_steadily, (function, row), {}) for row in rows))


def each(
    function: Callable[..., T], *columns: Sequence[Any], done: Callable[[], None] | None = None
) -> list[T]:
    """Return [function(*row) for row in zip(*columns)], computed on the engine of `running`.

    Args:
        function: a module-level function, so that it can be pickled; it must not modify shared
            data.
        columns: sequences of arguments, all of the same length.
        done: called after each piece.
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


class SentOnce:
    """Base class of data that many pieces read.

    Dask's backend sends an argument only once to each worker if its reported size is large.
    """

    def __sizeof__(self) -> int:
        return 2**20
