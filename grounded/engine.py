"""Engine: where independent pieces of work run. Results do not depend on the number of workers.

The jobs of a study run through joblib: as processes on this machine (extra `studies`), or as tasks
of an existing Dask cluster through Dask's joblib backend (extra `cluster`). The pieces of one
computation (`each`: records of a fit, hypotheses of a diagnosis) are short, numerous and share
their data. On this machine they run in threads, which need no extra, because compiled code releases
the GIL. On a cluster, data that all of them read is sent once (`SentOnce`).

Both use one BLAS thread and keep freed memory (`steady`). The matrices are small, so OpenBLAS's own
threads wait for each other (three times the CPU of a diagnosis on two busy cores) and change the
order of summation. The arrays are large enough that the C library returns each to the system,
which then clears every page of the next one: 40 % of the time of a diagnosis.
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

STACK = 16 * 2**20  # [bytes] stack size of a thread: kernels keep their matrices there
CONNECT_S = 10.0  # [s] timeout for a cluster's scheduler to answer
TRIM, MAP = -1, -3  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD of the GNU C library
LARGE = 2**28  # [bytes] freed blocks up to this size are reused
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
    mallopt(MAP, LARGE)
    mallopt(TRIM, LARGE)


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
            raise GroundedError(f"--jobs must be 1 or more, got {self.jobs}")
        if self.name not in ("local", "dask"):
            raise GroundedError(f"--engine must be 'local' or 'dask', got '{self.name}'")
        if (self.name == "dask") != (self.address is not None):
            raise GroundedError(
                "--address (tcp://host:8786) is required with --engine dask and only valid there"
            )

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
    """Make `each` use this engine inside the block; None: run in this process.

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
    """Run the functions on the cluster; yield the result of each row."""
    return pool((_steadily, row, {}) for row in zip(functions, *columns, strict=True))  # type: ignore[no-any-return]


def each(
    function: Callable[..., T], *columns: Sequence[Any], done: Callable[[], None] | None = None
) -> list[T]:
    """Return [function(*row) for row in zip(*columns)], computed on the engine of `running`.

    Args:
        function: a module-level function, so that it can be pickled; it must not modify shared
            data.
        columns: sequences of arguments, all of the same length.
        done: called after each piece, in order.
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
    with np.errstate(all="ignore"):  # workers do not inherit this setting
        return function(*row)


@steady()
def _steadily(function: Callable[..., T], *row: Any) -> T:
    return _quietly(function, *row)


class SentOnce:
    """Base class of data that many pieces read.

    Dask's backend sends an argument only once to each worker if its reported size is large.
    """

    def __sizeof__(self) -> int:
        return 2**20
