"""How long computations use the machine: one BLAS thread, and pages that stay with the process.

Matrices here are small: the threads that OpenBLAS starts by itself wait for one another and burn a
core each (three times the CPU of a diagnosis on two busy cores), and sum in another order. Arrays
are large enough that the C library hands each back to the system, which then clears every page of
the next one: 40 % of a diagnosis.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

TRIM, MAP = -1, -3  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD of the GNU C library
LARGE = 2**28  # [bytes] blocks up to here are reused


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
