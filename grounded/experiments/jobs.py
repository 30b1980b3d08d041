"""Studies as independent, seeded jobs, whose results do not depend on the workers.

A job is a call of a module-level function with plain numbers and names. It draws all random numbers
from its own seed, so the same seeds give the same results bit for bit on one worker or on fifty.
`grounded.engine` decides where jobs run; a lost worker ends the study.

The module also has the statistics that studies report: means with standard errors, improvements,
tables. The improvement of a utility (never positive) from U_0 to U is (U - U_0) / |U_0|, so 0.76
means that 76 % of the cost is gone. The paper does not say whether its 76 % is a mean of ratios or
a ratio of means; both are given.
"""

from __future__ import annotations

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
R = TypeVar("R")


def run_jobs(
    function: Callable[..., R],
    cases: Iterable[dict[str, Any]],
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> list[R]:
    """Call a module-level function with the arguments of each case; return the results in order.

    Args:
        function: of plain arguments.
        cases: the arguments by name, one job each.
        engine: where the jobs run; None: in this process.
        progress: called with the number of jobs done and the total.
    """
    rows, results = [*enumerate(cases)], dict[int, R]()
    tell = progress or (lambda done, total: None)
    tell(0, len(rows))
    try:
        for i, result in processes(engine or Engine(), partial(_call, function), rows):
            results[i] = result
            tell(len(results), len(rows))
    except BrokenProcessPool as error:
        undone = len(rows) - len(results)
        raise refused("run.workers", lost=undone, total=len(rows), why=str(error)) from None
    return [results[i] for i in range(len(rows))]


def _call(function: Callable[..., R], row: tuple[int, dict[str, Any]]) -> tuple[int, R]:
    return row[0], function(**row[1])


@dataclass(frozen=True)
class StudyTable:
    """A title, column headers and rows of text, for the terminal and for docs/experiments.md."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Study:
    """What a study found."""

    document: dict[str, Any]  # of `grounded experiment NAME --json`
    shown: tuple[StudyTable, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the document."""
        return self.document

    def tables(self) -> tuple[StudyTable, ...]:
        """Return its figures beside the paper's."""
        return self.shown


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
