"""Studies as independent, seeded jobs, whose results do not depend on the workers.

A job is a call of a module-level function with plain numbers and names; it returns plain JSON
values. It draws all random numbers from its own seed, so the same seeds give the same results bit
for bit on one worker or on fifty. `grounded.engine` decides where jobs run; a lost worker ends the
study.

The module also has the statistics that studies report: means with standard errors, improvements,
tables. The improvement of a utility (never positive) from U_0 to U is (U - U_0) / |U_0|, so 0.76
means that 76 % of the cost is gone. The paper does not say whether its 76 % is a mean of ratios or
a ratio of means; both are given.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np

from grounded.checks import refused
from grounded.engine import Engine, processes

Progress = Callable[[int, int], None]  # jobs done, jobs in all
Arguments = dict[str, Any]
R = TypeVar("R")


def run_jobs(
    function: Callable[..., dict[str, Any]],
    cases: Iterable[Arguments],
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Call a module-level function with the arguments of each case; return the results in order.

    Args:
        function: of JSON-like arguments.
        cases: the arguments by name, one job each.
        engine: where the jobs run; None: in this process.
        progress: called with the number of jobs done and the total.

    Raises:
        GroundedError: if a worker dies.
    """
    rows = [*enumerate(cases)]
    results, total = dict[int, dict[str, Any]](), len(rows)
    tell = progress or (lambda done, total: None)
    tell(0, total)
    try:
        for i, result in processes(engine or Engine(), partial(_call, function), rows):
            results[i] = result
            tell(len(results), total)
    except BrokenProcessPool as error:
        undone = total - len(results)
        raise refused("run.workers", lost=undone, total=total, why=str(error)) from None
    return [results[i] for i in range(total)]


def run_study(
    kind: type[R],
    function: Callable[..., dict[str, Any]],
    cases: Iterable[Arguments],
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> tuple[R, ...]:
    """Return each result of `run_jobs` as a dataclass with its names, JSON lists as tuples."""
    found = run_jobs(function, cases, engine, progress)
    tuples = ({k: tuple(v) if isinstance(v, list) else v for k, v in r.items()} for r in found)
    return tuple(kind(**result) for result in tuples)


def _call(
    function: Callable[..., dict[str, Any]], row: tuple[int, Arguments]
) -> tuple[int, dict[str, Any]]:
    # through JSON and back: results are plain values
    return row[0], json.loads(json.dumps(function(**row[1])))


@dataclass(frozen=True)
class StudyTable:
    """A title, column headers and rows of text, for the terminal and for docs/experiments.md."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def improvement(before: float, after: float) -> float:
    """Return the share of the cost that is gone."""
    return (after - before) / abs(before)


def mean_se(values: Sequence[float]) -> tuple[float, float]:
    """Return the mean of one value or more and its standard error (NaN for a single one)."""
    data = np.asarray(values, dtype=float)
    several = len(data) > 1
    return float(data.mean()), float(data.std(ddof=1) / len(data) ** 0.5) if several else math.nan


def mean_text(values: Sequence[float], digits: str = ".1%") -> str:
    """Return text such as `76.1% (±0.4%)`, or the mean alone for a single value."""
    mean, se = mean_se(values)
    return f"{mean:{digits}}" if len(values) < 2 else f"{mean:{digits}} (±{se:{digits}})"
