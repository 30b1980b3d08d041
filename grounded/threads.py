"""One BLAS thread: matrices here are small, and threads that wait for one another burn a core each.

On two busy cores a diagnosis took three times the CPU with the threads that OpenBLAS starts by
itself, and sums came out in another order. What runs side by side are whole fits.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limits NumPy's and SciPy's BLAS; also a decorator, `@one_blas_thread()`."""
    import scipy.linalg  # noqa: F401  SciPy's BLAS is another one, loaded with it
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, user_api="blas"):
        yield
