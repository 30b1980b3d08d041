"""The pace of the machine that runs the tests: a limit of seconds means nothing without it."""

from __future__ import annotations

import time

_TURNS, _REFERENCE = 1_000_000, 0.08  # [s] of CPU on the machine on which the limits were measured


def slowness() -> float:
    """How many times as long this machine takes now for plain Python as the reference, at least 1.

    Shared machines run at a third of their speed for hours; a limit is multiplied by this, so that
    a test tells that the code grew slower and not that the neighbours are busy.
    """
    began, total = time.process_time(), 0
    for i in range(_TURNS):
        total += i * i
    return max(1.0, (time.process_time() - began) / _REFERENCE)
