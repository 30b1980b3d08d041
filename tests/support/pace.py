"""The current speed of the test machine, by which time limits are scaled."""

from __future__ import annotations

import time

_TURNS, _REFERENCE = 1_000_000, 0.08  # [s] of CPU on the machine on which the limits were measured


def slowness() -> float:
    """Return how many times slower than the reference this machine runs plain Python, at least 1.

    Shared machines may run at a third of their speed for hours. Limits are multiplied by this, so
    that a test fails if the code is slower and not if the machine is busy.
    """
    began, total = time.process_time(), 0
    for i in range(_TURNS):
        total += i * i
    return max(1.0, (time.process_time() - began) / _REFERENCE)


def crowding() -> float:
    """Return how many times longer than its CPU time a computation takes now, at least 1."""
    used, began = time.process_time(), time.perf_counter()
    while time.process_time() - used < _REFERENCE:
        sum(range(1000))
    return max(1.0, (time.perf_counter() - began) / _REFERENCE)
