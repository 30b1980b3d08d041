"""Many models or trials at once: compiled kernels release the GIL, so threads are enough."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
STACK = 16 * 2**20  # bytes for each thread: kernels keep their matrices there


def parallel(
    function: Callable[[Item], Result], items: Iterable[Item], workers: int | None = None
) -> list[Result]:
    """[function(item) for item in items], in that order, by threads.

    Args:
        function: must not change anything shared.
        items: what it is called with.
        workers: threads; None: as many as the process may use processors.

    Raises:
        Exception: the first that `function` raises, in the order of the items.
    """
    work = list(items)
    count = min(len(work), workers or _processors())
    if count <= 1:
        return [function(item) for item in work]
    from concurrent.futures import ThreadPoolExecutor

    before = threading.stack_size(STACK)
    try:
        with ThreadPoolExecutor(count) as pool:
            return list(pool.map(function, work))
    finally:
        threading.stack_size(before)


def _processors() -> int:
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS, Windows
        return os.cpu_count() or 1
