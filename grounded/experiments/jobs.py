"""Studies as lists of independent, seeded jobs, whose results do not depend on the workers.

A job is a module-level function called with plain numbers and names, and returns plain JSON values.
It draws all random numbers from its own seed, so the same seeds give the same results bit for bit
on one worker or on fifty. `grounded.engine` decides where jobs run; a lost worker ends the study.

The module also has the statistics that studies report: means with standard errors, improvements,
slopes, tables. The improvement of a utility (never positive) from U_0 to U is (U - U_0) / |U_0|, so
0.76 means that 76 % of the cost is gone. The paper does not say whether its 76 % is a mean of
ratios or a ratio of means; both are given.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import product
from typing import Any, TypedDict, TypeVar, Unpack

import numpy as np

from grounded.checks import refused
from grounded.engine import Engine, processes

Progress = Callable[[int, int], None]  # jobs done, jobs in all
R = TypeVar("R")


@dataclass(frozen=True)
class Job:
    """One call of a module-level function with JSON-like arguments."""

    function: Callable[..., dict[str, Any]]
    arguments: dict[str, Any]


class Running(TypedDict, total=False):
    """How a study runs its jobs: the keyword arguments of `run_jobs`."""

    engine: Engine | None
    progress: Progress | None


def run_jobs(
    jobs: Sequence[Job],
    engine: Engine | None = None,
    *,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Run jobs and return their results in the same order.

    Args:
        jobs: the jobs.
        engine: where they run; None: in this process.
        progress: called with the number of jobs done and the total.

    Raises:
        GroundedError: if a worker dies.
    """
    results, total = dict[int, dict[str, Any]](), len(jobs)
    tell = progress or (lambda done, total: None)
    tell(0, total)
    try:
        for i, result in processes(engine or Engine(), _call, [*enumerate(jobs)]):
            results[i] = result
            tell(len(results), total)
    except BrokenProcessPool as error:
        undone = total - len(results)
        raise refused("run.workers", lost=undone, total=total, why=str(error)) from None
    return [results[i] for i in range(total)]


def every(**axes: Iterable[Any]) -> list[dict[str, Any]]:
    """Return the cases of a grid: all combinations of the values of the arguments."""
    return [dict(zip(axes, values, strict=True)) for values in product(*axes.values())]


def run_study(
    kind: type[R],
    function: Callable[..., dict[str, Any]],
    cases: Iterable[dict[str, Any]],
    **how: Unpack[Running],
) -> tuple[R, ...]:
    """Run one job per case and return each result as a `kind`, JSON lists as tuples.

    Args:
        kind: a dataclass with the names in the results as fields.
        function: the function of the jobs.
        cases: the arguments of each job.
        how: where the jobs run, see `run_jobs`.
    """
    found = run_jobs([Job(function, case) for case in cases], **how)
    tuples = ({k: tuple(v) if isinstance(v, list) else v for k, v in r.items()} for r in found)
    return tuple(kind(**result) for result in tuples)


def _call(row: tuple[int, Job]) -> tuple[int, dict[str, Any]]:
    # through JSON and back: results are plain values
    i, job = row
    return i, json.loads(json.dumps(job.function(**job.arguments)))


@dataclass(frozen=True)
class StudyTable:
    """A title, column headers and rows of text, for the terminal and for docs/experiments.md."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def improvement(before: float, after: float) -> float:
    """Return the share of the cost that is gone."""
    return (after - before) / abs(before)


def mean_text(values: Sequence[float], digits: str = ".1%", of_error: str = ".1%") -> str:
    """Return text such as `76.1% (±0.4%)`, or the mean alone for a single value."""
    mean, se = mean_se(values)
    return f"{mean:{digits}}" if len(values) < 2 else f"{mean:{digits}} (±{se:{of_error}})"


def mean_se(values: Sequence[float]) -> tuple[float, float]:
    """Return the mean and its standard error (NaN for fewer than two values)."""
    data = np.asarray(values, dtype=float)
    if len(data) < 2:
        return (float(data.mean()) if len(data) else math.nan), math.nan
    return float(data.mean()), float(data.std(ddof=1) / math.sqrt(len(data)))


def loglog_slope(x: Sequence[float], y: Sequence[float]) -> float:
    """Return the least-squares slope of log y over log x."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])
