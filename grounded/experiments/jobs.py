"""Studies as lists of independent, seeded jobs, whose results do not depend on the workers.

A job is a module-level function called with plain numbers and names, and returns plain JSON values.
It draws all random numbers from its own seed, so the same seeds give the same results bit for bit
on one worker or on fifty. `grounded.engine` decides where jobs run.

    finished    a mapping from a job's key to its result; jobs found in it are not run again. The
                caller may keep it on disk, so that an interrupted study can be continued. The key
                contains a hash of the sources, so that results of two versions are never mixed.
    lost worker it ends the study, and running it again goes on from what is finished.

The module also has the statistics that studies report: means with standard errors, improvements,
slopes, tables. The improvement of a utility (never positive) from U_0 to U is (U - U_0) / |U_0|, so
0.76 means that 76 % of the cost is gone. The paper does not say whether its 76 % is a mean of
ratios or a ratio of means; both are given.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, MutableMapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, TypedDict, TypeVar, Unpack

import numpy as np

from grounded.checks import refused
from grounded.engine import Engine, processes

Progress = Callable[[int, int], None]  # jobs done, jobs in all
R = TypeVar("R")


@cache
def code() -> str:
    """Return a hash of this package's sources, since results depend on them."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[1]
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:12]


@dataclass(frozen=True)
class Job:
    """One call of a module-level function with JSON-like arguments."""

    function: Callable[..., dict[str, Any]]
    arguments: dict[str, Any]

    @property
    def key(self) -> str:
        """Key of its result: a hash of the code, the function's name and its arguments."""
        name = f"{code()} {self.function.__module__}.{self.function.__name__}"
        return f"{name}:{json.dumps(self.arguments, sort_keys=True)}"


class Running(TypedDict, total=False):
    """How a study runs its jobs: the keyword arguments of `run_jobs`."""

    engine: Engine | None
    finished: MutableMapping[str, dict[str, Any]] | None
    progress: Progress | None


def run_jobs(
    jobs: Sequence[Job],
    engine: Engine | None = None,
    *,
    finished: MutableMapping[str, dict[str, Any]] | None = None,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Run jobs and return their results in the same order.

    Args:
        jobs: the jobs.
        engine: where they run; None: in this process.
        finished: results by `Job.key`; read first, and filled as jobs end.
        progress: called with the number of jobs done and the total.

    Raises:
        GroundedError: if a worker dies.
    """
    engine, finished = engine or Engine(), {} if finished is None else finished
    results = {job.key: finished[job.key] for job in jobs if job.key in finished}
    waiting = list({job.key: job for job in jobs if job.key not in results}.values())
    total = len(results) + len(waiting)

    def keep(key: str, result: dict[str, Any]) -> None:
        finished[key] = results[key] = result
        if progress:
            progress(len(results), total)

    if progress:
        progress(len(results), total)
    try:
        for key, result in processes(engine, _call, waiting):
            keep(key, result)
    except BrokenProcessPool as error:
        undone = total - len(results)
        raise refused("run.workers", lost=undone, total=total, why=str(error)) from None
    return [results[job.key] for job in jobs]


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


def _call(job: Job) -> tuple[str, dict[str, Any]]:
    # through JSON and back, so that new results equal those read from disk
    return job.key, json.loads(json.dumps(job.function(**job.arguments)))


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
