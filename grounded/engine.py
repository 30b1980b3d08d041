"""Engine: where independent pieces of work run; how many workers there are changes no bit.

The jobs of a study are joblib's: processes on this machine (extra `studies`), or tasks of an
existing Dask cluster through Dask's own joblib backend (extra `cluster`). The pieces of one
computation (`each`: records of a fit, hypotheses of a diagnosis) are many and short and share their
data: on this machine they are threads, which need no extra, because compiled passes leave Python's
lock; on a cluster what all of them read is sent once (`SentOnce`).

Either uses one BLAS thread, and keeps its pages (`steady`). Matrices here are small: the threads
that OpenBLAS starts by itself wait for one another and burn a core each (three times the CPU of a
diagnosis on two busy cores), and sum in another order. Arrays are large enough that the C library
hands each back to the system, which then clears every page of the next one: 40 % of a diagnosis.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, TypeVar

import numpy as np

from grounded.errors import GroundedError, needs

STACK = 16 * 2**20  # [bytes] of a thread: kernels keep their matrices there
CONNECT_S = 10.0  # for a cluster's scheduler to answer
TRIM, MAP = -1, -3  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD of the GNU C library
LARGE = 2**28  # [bytes] blocks up to here are reused
T = TypeVar("T")


@contextmanager
def steady() -> Iterator[None]:
    """One BLAS thread for NumPy and SciPy, and pages kept; also a decorator, `@steady()`."""
    import scipy.linalg  # noqa: F401  SciPy's BLAS is another one, loaded with it
    from threadpoolctl import threadpool_limits

    _keep_pages()
    with threadpool_limits(1, user_api="blas"):
        yield


@cache
def _keep_pages() -> None:
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library
        return
    mallopt(MAP, LARGE)
    mallopt(TRIM, LARGE)


@dataclass(frozen=True)
class Engine:
    """Where pieces of work run.

    Args:
        jobs: workers on this machine; 1 runs all in this process.
        name: "local", or "dask" for a running cluster.
        address: the cluster's scheduler, such as "tcp://10.0.0.1:8786".
    """

    jobs: int = 1
    name: str = "local"
    address: str | None = None

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise GroundedError(f"--jobs must be 1 or more, got {self.jobs}")
        if self.name not in ("local", "dask"):
            raise GroundedError(f"--engine must be 'local' or 'dask', got '{self.name}'")
        if (self.name == "dask") != (self.address is not None):
            raise GroundedError(
                "--engine dask needs the scheduler's --address (tcp://host:8786), and only it does"
            )

    @property
    def alone(self) -> bool:
        """Whether all runs in this process, one after the other."""
        return self.name == "local" and self.jobs == 1

    @contextmanager
    def pool(self, **settings: Any) -> Iterator[Any]:
        """A `joblib.Parallel` on these workers; the cluster stays, the connection is closed.

        Args:
            settings: of joblib's.

        Raises:
            GroundedError: if joblib or Dask is missing, or no scheduler answers.
        """
        joblib = needs("joblib", "studies")
        if self.name == "local":
            # One BLAS thread a worker: results don't depend on how many share the machine.
            here = joblib.parallel_config(backend="loky", inner_max_num_threads=1)
            with here, joblib.Parallel(n_jobs=self.jobs, **settings) as pool:
                yield pool
            return
        distributed = needs("distributed", "cluster")
        try:
            client = distributed.Client(self.address, timeout=CONNECT_S)
        except OSError as error:
            raise GroundedError(
                f"no Dask scheduler answers at {self.address}: is it running? ({error})"
            ) from error
        try:
            there = joblib.parallel_config(backend="dask", client=client)
            with there, joblib.Parallel(n_jobs=-1, **settings) as pool:
                yield pool
        finally:
            client.close()


_pool: ContextVar[Any] = ContextVar("pool", default=None)


@contextmanager
def running(engine: Engine | None) -> Iterator[None]:
    """What `each` is called for inside runs on this engine; None: in this process.

    Raises:
        GroundedError: as `Engine.pool`.
    """
    if engine is None or engine.alone:
        yield
        return
    with ExitStack() as stack:
        if engine.name == "local":
            stack.callback(threading.stack_size, threading.stack_size(STACK))
            threads = stack.enter_context(ThreadPoolExecutor(engine.jobs))
            call: Callable[..., Iterable[Any]] = partial(threads.map, _quietly)
        else:
            pool = stack.enter_context(engine.pool(batch_size=1, return_as="generator"))
            call = partial(_sent, pool)
        before = _pool.set(call)
        try:
            yield
        finally:
            _pool.reset(before)


def _sent(pool: Any, functions: Iterable[Any], *columns: Iterable[Any]) -> Iterable[Any]:
    """What a cluster makes of each row."""
    return pool((_steadily, row, {}) for row in zip(functions, *columns, strict=True))  # type: ignore[no-any-return]


def each(
    function: Callable[..., T], *columns: Sequence[Any], done: Callable[[], None] | None = None
) -> list[T]:
    """[function(*row) for row in zip(*columns)], wherever `running` says.

    Args:
        function: of a module, so that a cluster knows it; it changes nothing that is shared.
        columns: its arguments, of one length each.
        done: called as pieces end, in their order.
    """
    results, many, call = list[T](), len(columns[0]), _pool.get()
    if call is None or many < 2:
        found: Iterable[T] = map(function, *columns)
    else:
        found = call([function] * many, *columns)
    for result in found:
        results.append(result)
        if done is not None:
            done()
    return results


def _quietly(function: Callable[..., T], *row: Any) -> T:
    with np.errstate(all="ignore"):  # a worker does not inherit it
        return function(*row)


@steady()
def _steadily(function: Callable[..., T], *row: Any) -> T:
    return _quietly(function, *row)  # another process has settings of its own


class SentOnce:
    """What many pieces read: Dask's backend sends arguments that look large to a worker once."""

    def __sizeof__(self) -> int:
        return 2**20
