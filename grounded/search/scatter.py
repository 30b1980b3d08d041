"""How far the utilities of runs of one policy scatter: one number for all that is said of luck.

Two runs whose utilities happen to agree give a spread near zero, and few candidates are run more
than twice. So what is known is pooled:

    over candidates   those that were repeated and cost about as much: a wild policy's scatter says
                      nothing of a tame one's, and the other way round
    within runs       a utility is the sum of what PIECES parts of the run are worth. That two sums
                      agree by luck, their parts don't: with B the sum of the parts' variances and A
                      that of the utilities, (nu A + mu B) / (nu + mu)

nu is the number of repeats. mu is what the parts add: the effective degrees of freedom of B
(Satterthwaite, "An approximate distribution of estimates of variance components", Biometrics
Bulletin 2, 1946), less nu, and at most PIECES - 1, so that many repeats outweigh the assumption
that parts scatter independently of each other. This is a conjugate prior on the variance (Gelman
et al., *Bayesian Data Analysis*, 2013, section 2.6); Student's t has nu + mu degrees of freedom.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.frozen import Array
from grounded.search.candidate import Tried
from grounded.task import Task
from grounded.trial import Trial

PIECES = 4  # of a run
FAR = 2.0  # times the cost of a candidate: others scatter otherwise


@dataclass(frozen=True)
class Scatter:
    """Of a single run's utility: its variance, nan where nothing was repeated."""

    variance: float = math.nan
    freedom: float = 0.0  # degrees of freedom of that estimate

    @property
    def known(self) -> bool:
        """Whether anything was repeated."""
        return self.freedom > 0

    def error(self, runs: int) -> float:
        """Standard error of the mean of so many runs."""
        return math.sqrt(self.variance / runs)


def by_pieces(task: Task, trials: Sequence[Trial]) -> Array:
    """What each of PIECES parts of each run is worth (runs, PIECES); rows sum to the utilities."""
    worth = [task.rewards(trial) for trial in trials]
    return np.array([[part.sum() for part in np.array_split(r, PIECES)] for r in worth])


class Repeats:
    """The candidates that were repeated, each with its cost and its sums of squares."""

    def __init__(self, history: Iterable[Tried]) -> None:
        rows = [_sums(tried) for tried in history if _repeated(tried)]
        if any(row[2:].any() for row in rows):  # runs that agree to the last bit are copies then
            rows = [row for row in rows if row[2:].any()]
        self.rows = np.array(rows).reshape(len(rows), 3 + PIECES)

    def near(self, utility: float) -> Scatter:
        """The scatter of runs that are worth about so much."""
        cost, each = abs(utility), np.abs(self.rows[:, 0])
        some = self.rows[(each <= FAR * cost) & (cost <= FAR * each)]
        nu, total = float(some[:, 1].sum()), float(some[:, 2].sum())
        parts = some[:, 3:].sum(axis=0)
        if not (nu and math.isfinite(total + parts.sum())):
            return Scatter()
        share = parts / (parts.sum() or 1.0)
        added = min(nu / float((share**2).sum() or 1.0) - nu, PIECES - 1.0)
        return Scatter((total + added * float(parts.sum()) / nu) / (nu + added), nu + added)


def with_errors(history: Sequence[Tried]) -> tuple[Tried, ...]:
    """The same, each with the scatter of what was repeated near it."""
    near = Repeats(history).near
    return tuple(replace(t, deviation=math.sqrt(near(t.utility).variance)) for t in history)


def _repeated(tried: Tried) -> bool:
    return len(tried.utilities) > 1 and all(map(math.isfinite, tried.utilities))


def _sums(tried: Tried) -> Array:
    """Utility, degrees of freedom, sum of squares, those of the parts."""
    parts = np.zeros(PIECES)
    with np.errstate(over="ignore", invalid="ignore"):  # of runs that flew off
        if tried.pieces is not None:
            parts = ((tried.pieces - tried.pieces.mean(axis=0)) ** 2).sum(axis=0)
        total = float(np.var(tried.utilities)) * len(tried.utilities)
    return np.array([tried.utility, len(tried.utilities) - 1.0, total, *parts])
