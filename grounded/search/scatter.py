"""What noise does to utilities: how far those of runs of one policy scatter, and what it costs.

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

Sensors' noise also lowers every utility, since logged states are judged: a model that has seen no
trial promises a run without it (`noise_cost`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.frozen import Array, median
from grounded.policy import Policy
from grounded.search.candidate import Tried
from grounded.task import Task
from grounded.trial import Trial

PIECES = 4  # of a run
MEDIAN = 0.6745  # standard deviations that half of all normal numbers lie within
ORDERS = (2, 3, 4, 5)  # of differences
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


CHANCE = 3.0  # standard deviations of a sensor's noise that one row may be off by
NOTHING = 1e-9  # in a state's unit, or of its value: no difference at all


def beyond_noise(trials: Sequence[Trial], off: Array, start: Array) -> Array:
    """Whether the first rows of trials are off s_0 by more than their sensors' noise, (n,) bool.

    Args:
        trials: of one candidate.
        off: s_0 of each trial less that of the task, (N, n).
        start: s_0 of the task (n,).
    """
    noise = np.sqrt(np.mean([white_noise(t.states) ** 2 for t in trials], axis=0) / len(trials))
    least = np.maximum(CHANCE * noise, NOTHING * np.maximum(1.0, np.abs(start)))
    return np.asarray(np.abs(np.mean(off, axis=0)) > least)


def white_noise(states: Array) -> Array:
    """The white noise of each sensor (n,) by differences of states (H + 1, n); 0 of none.

    The k-th differences of white noise have (2k)! / k!^2 times its variance; those of a motion that
    is smooth over k samples vanish, so that the least of several orders has the least motion in it.
    """
    found = np.full(states.shape[1], np.inf)
    for order in ORDERS:
        for j, column in enumerate(np.abs(np.diff(states, n=order, axis=0)).T):
            known = column[np.isfinite(column)]
            white = MEDIAN * math.sqrt(math.comb(2 * order, order))
            found[j] = min(found[j], median(known) / white if len(known) else np.inf)
    return np.where(np.isfinite(found), found, 0.0)


def noise_cost(task: Task, policy: Policy, noise: Array) -> float:
    """What sensors' noise takes from the utility of a logged run in the mean; >= 0.

    The noise itself, where states are weighed, and the inputs that the gains make of it. What those
    inputs move is left out: the robot is slow beside white noise.

    Args:
        task: whose reward judges the log.
        policy: that is run.
        noise: standard deviations of the sensors' white noise, (n,), in the states' units.
    """
    reward, steps = task.reward, task.horizon
    cost = float(noise**2 @ ((steps + 1) * reward.state + reward.terminal))
    if policy.gain is None:
        return cost
    moved = policy.gain[:, :, : task.model.n] ** 2 @ noise**2  # (H, m): variances of inputs
    changes = moved + np.vstack([np.zeros_like(moved[:1]), moved[:-1]])
    return cost + float((moved @ reward.input + changes @ reward.input_change).sum())


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
