"""What the benchmarks share: CPU times, commands as processes, Markdown tables."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple


class Ran(NamedTuple):
    """What a process printed, its CPU time with that of its children, and its peak memory."""

    out: str
    seconds: float
    megabytes: float
    status: int


def fastest(function: Callable[[], object], repeats: int = 20) -> float:
    """Return the least CPU seconds of a few calls, child processes included."""

    def spent() -> float:
        ended = resource.getrusage(resource.RUSAGE_CHILDREN)
        return time.process_time() + ended.ru_utime + ended.ru_stime

    times = []
    for _ in range(repeats):
        start = spent()
        function()
        times.append(spent() - start)
    return min(times)


def python(*words: str, **environment: str) -> Ran:
    """Run Python with some words as a process of its own."""
    process = subprocess.Popen(
        [sys.executable, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"} | environment,
    )
    out = process.stdout.read()
    _, status, used = os.wait4(process.pid, 0)
    return Ran(out, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, status)


def grounded(*words: object, **environment: str) -> Ran:
    """Run a command of ours as a process of its own."""
    return python("-m", "grounded_cli.main", *map(str, words), **environment)


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)
