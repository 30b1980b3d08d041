"""Noise of utilities: the scatter between runs of one policy, and the cost of sensor noise.

Two runs may have nearly equal utilities by chance, and few candidates are run more than twice. So
the variance is estimated from pooled data:

    over candidates   all repeated candidates of about the same cost: the scatter of a poor policy
                      says nothing about that of a good one
    within runs       a utility is the sum over PIECES parts of the run. Two sums may agree by
                      chance, but hardly all of their parts. With A the variance of the utilities
                      and B the sum of the variances of the parts: (nu A + mu B) / (nu + mu)

nu is the number of repeats. mu is the additional information of the parts: the effective degrees of
freedom of B (Satterthwaite, "An approximate distribution of estimates of variance components",
Biometrics Bulletin 2, 1946), less nu, and at most PIECES - 1, so that many repeats outweigh the
assumption that the parts are independent. This is a conjugate prior on the variance (Gelman et al.,
*Bayesian Data Analysis*, 2013, section 2.6); Student's t has nu + mu degrees of freedom.

Sensor noise also lowers every utility, since logged states are judged (`noise_cost`). A model that
has seen no trial predicts a run without it; one that replays the mean of a candidate's trials
predicts a run with the noise of that mean, which is less than that of a log (`noise_missed`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from grounded.frozen import MEDIAN, Array, median
from grounded.policy import Policy
from grounded.search.candidate import Candidate, Tried
from grounded.task import Task
from grounded.trial import Trial

PIECES = 4  # parts of a run
LATEST, ROWS = 9, 10_000  # trials from which the noise of the sensors is estimated; rows of each
HUGE = 1e100  # bound on the noise of a diverged run, in the state's unit
LEFT = 0.5  # share of the variance of repeats that starts may leave if they are most of it
LARGEST_COST_RATIO = 2.0  # largest ratio of costs of candidates whose scatter is pooled


@dataclass(frozen=True)
class Scatter:
    """Variance of a single run's utility; nan if nothing was repeated."""

    variance: float = math.nan
    freedom: float = 0.0  # degrees of freedom of that estimate
    repeats: int = 0  # runs beyond the first of each candidate that it rests on

    @property
    def known(self) -> bool:
        """Whether anything was repeated."""
        return self.freedom > 0

    def error(self, runs: int) -> float:
        """Return the standard error of the mean of `runs` runs."""
        return math.sqrt(self.variance / runs)


def by_pieces(task: Task, trials: Sequence[Trial]) -> Array:
    """Return the utility of each part of each run, (runs, PIECES); rows sum to the utilities."""
    worth = [task.rewards(trial) for trial in trials]
    return np.array([[part.sum() for part in np.array_split(r, PIECES)] for r in worth])


CHANCE = 3.0  # standard deviations of sensor noise by which one sample may differ
SLOW_S, SLOWER = 0.1, 3.0  # [s] of second differences; times the white noise, at most
WHITE = MEDIAN * 6**0.5  # median of absolute second differences of white noise of std 1
FEWEST = 10  # least number of second differences
SAME_START = 1e-9  # difference treated as zero, in the state's unit or relative to its value


def beyond_noise(trials: Sequence[Trial], off: Array, start: Array, predicted: Array) -> Array:
    """Return which start states differ from s_0 by more than the sensor noise, (n,) bool.

    Args:
        trials: N trials of one candidate.
        off: first state of each trial less s_0, (N, n).
        start: s_0 of the task (n,).
        predicted: their candidate's predicted states (H+1, n).
    """
    each = [sample_noise(trial, predicted) ** 2 for trial in trials]
    noise = np.sqrt(np.mean(each, axis=0) / len(trials))
    least = np.maximum(CHANCE * noise, SAME_START * np.maximum(1.0, np.abs(start)))
    return np.asarray(np.abs(np.mean(off, axis=0)) > least)


def sample_noise(trial: Trial, predicted: Array) -> Array:
    """Return the noise (std) of single samples of a run, (n,), also of filtered signals.

    The noise of a filtered speed changes little from sample to sample, so that second differences
    of neighbours don't show it. Those over SLOW_S show it, of what differs from the prediction, as
    the motion bends, too. They are bounded, since an error of the model bends as well.

    Args:
        trial: a run of a candidate.
        predicted: its predicted states (H+1, n).
    """
    white, lag = trial.noise(), max(1, round(SLOW_S / trial.dt))
    T = min(len(predicted), trial.finite_steps + 1)
    if 2 * lag + FEWEST > T:
        return white
    off = trial.states[:T] - predicted[:T]
    bends = np.abs(off[2 * lag :] - 2 * off[lag:-lag] + off[: -2 * lag])
    return np.asarray(np.clip(median(bends) / WHITE, white, SLOWER * white))


def sensor_noise(trials: Sequence[Trial], n: int) -> Array:
    """Return the noise (std) of a sample of each state's sensor, (n,); 0 without a trial.

    It is the median over the latest trials. The estimate of a single short run is off by a third
    either way. Of a long log its first rows are enough.
    """
    each = [trial.noise(ROWS) for trial in trials[-LATEST:]]
    return median(np.minimum(each, HUGE)) if each else np.zeros(n)


class NoiseSoFar:
    """The noise of the sensors as it was known at some time, see `sensor_noise`.

    Args:
        trials: all trials, in order of storage.
        n: number of states.
    """

    def __init__(self, trials: Sequence[Trial], n: int) -> None:
        self.trials, self.n, self._found = trials, n, dict[int, Array]()

    @property
    def now(self) -> Array:
        """The noise by the latest trials, (n,)."""
        return self._at(len(self.trials))

    def first(self, candidate: str) -> int:
        """Return the place of the first trial of a candidate among all, their number if none."""
        return self._first.get(candidate, len(self.trials))

    def before(self, first: int, seen: Sequence[str] = ()) -> Array:
        """Return the noise by the trials before one; if it is the first, by that one.

        Args:
            first: place of the first trial of a candidate, or of one that was made later.
            seen: ids of the search's trials when the candidate was made, after which trials are
                none of its promise, such as a log that is data only.
        """
        places = (self._place.get(name, first) for name in seen)
        last = max((k + 1 for k in places if k < first), default=max(1, first))
        return self._at(last)

    @cached_property
    def _place(self) -> dict[str, int]:
        return {trial.id: k for k, trial in enumerate(self.trials)}

    @cached_property
    def _first(self) -> dict[str, int]:
        last = len(self.trials) - 1
        return {trial.candidate: last - k for k, trial in enumerate(reversed(self.trials))}

    def _at(self, count: int) -> Array:
        if count not in self._found:
            self._found[count] = sensor_noise(self.trials[:count], self.n)
        return self._found[count]


def noise_cost(task: Task, policy: Policy, noise: Array) -> float:
    """Return the mean loss of utility of a logged run due to sensor noise; >= 0.

    It counts the noise of weighted states and the inputs that the gains derive from it. The motion
    that these inputs cause is neglected: robots are slow compared with white noise.

    Args:
        task: its reward judges the log.
        policy: the policy that is run.
        noise: standard deviations of the sensors' white noise, (n,), in the states' units.
    """
    reward, steps = task.reward, task.horizon
    cost = float(noise**2 @ ((steps + 1) * reward.state + reward.terminal))
    if policy.gain is None:
        return cost
    moved = policy.gain[:, :, : task.model.n] ** 2 @ noise**2  # (H, m): variances of inputs
    changes = moved + np.vstack([np.zeros_like(moved[:1]), moved[:-1]])
    return cost + float((moved @ reward.input + changes @ reward.input_change).sum())


def noise_missed(task: Task, made: Candidate, noise: Array) -> float:
    """Return how much of the cost of sensor noise in a log a candidate's prediction lacks; >= 0.

    All of it, if the model that predicted it replays no trial. Otherwise the bias of that model
    contains the noise of the trials that it replays, and the predicted run shows it: as much as a
    log after a single run, of which nothing must be added twice, and 1 / sqrt(N) of it after N runs
    whose mean is replayed. How much it shows is measured as in the logs, with the same estimate, as
    a step may also have smoothed it.

    Args:
        task: its reward judges the log.
        made: the candidate.
        noise: standard deviations of the sensors' white noise, (n,), in the states' units.
    """
    shown = made.shown_noise if made.grounded else np.zeros_like(noise)
    least = noise_cost(task, made.policy, noise) + made.predicted_utility
    missed = noise_cost(task, made.policy, np.sqrt(np.maximum(noise**2 - shown**2, 0.0)))
    return max(missed, least)


class Repeats:
    """The candidates that were run repeatedly, with their costs and sums of squares."""

    def __init__(self, history: Iterable[Tried]) -> None:
        rows = [_sums(tried) for tried in history if _repeated(tried)]
        if any(row[2:].any() for row in rows):  # then identical runs must be copies
            rows = [row for row in rows if row[2:].any()]
        self.rows = np.array(rows).reshape(len(rows), 3 + PIECES)

    def near(self, utility: float) -> Scatter:
        """Return the scatter of runs of about this utility; none if all repeats agree exactly."""
        cost, each = abs(utility), np.abs(self.rows[:, 0])
        exact = not self.rows[:, 2:].any()  # then no run scatters, at whatever utility
        some = self.rows[
            exact | ((each <= LARGEST_COST_RATIO * cost) & (cost <= LARGEST_COST_RATIO * each))
        ]
        nu, total = float(some[:, 1].sum()), float(some[:, 2].sum())
        parts = some[:, 3:].sum(axis=0)
        if not (nu and math.isfinite(total + parts.sum())):
            return Scatter()
        share = parts / (parts.sum() or 1.0)
        added = min(nu / float((share**2).sum() or 1.0) - nu, PIECES - 1.0)
        variance = (total + added * float(parts.sum()) / nu) / (nu + added)
        return Scatter(variance, nu + added, round(nu))


def with_errors(history: Sequence[Tried], pool: Repeats) -> tuple[Tried, ...]:
    """Return the candidates, each with the standard deviation of a run of similar utility."""
    share = StartShare()
    for tried in history:
        share.add(tried)
    each = [(tried, pool.near(tried.utility)) for tried in history]
    return tuple(
        replace(t, deviation=math.sqrt(near.variance), repeats=near.repeats, placed=share.most)
        for t, near in each
    )


@dataclass
class StartShare:
    """How much of what repeats scatter by is due to where runs began, as the model tells."""

    whole: float = 0.0  # sum of squares of the utilities of repeats
    left: float = 0.0  # the same without what the starts cost

    def add(self, tried: Tried) -> None:
        """Add the repeats of a candidate."""
        if _repeated(tried) and tried.starts is not None:
            costs, worth = tried.starts.costs(tried), np.array(tried.utilities)
            if np.isfinite(costs).all():
                with np.errstate(all="ignore"):  # of diverged runs
                    self.whole += float(np.var(worth)) * len(worth)
                    self.left += float(np.var(worth + costs)) * len(worth)

    @property
    def most(self) -> bool:
        """Whether it is most of it."""
        return self.left < LEFT * self.whole


def _repeated(tried: Tried) -> bool:
    return len(tried.utilities) > 1 and all(map(math.isfinite, tried.utilities))


def _sums(tried: Tried) -> Array:
    """Return the utility, degrees of freedom, sum of squares, and sums of squares of the parts."""
    parts, total = np.zeros(PIECES), 0.0
    if len(set(tried.utilities)) == 1:  # exactly 0, which a rounded mean may miss
        return np.array([tried.utility, len(tried.utilities) - 1.0, total, *parts])
    with np.errstate(over="ignore", invalid="ignore"):  # diverged runs
        if tried.pieces is not None:
            parts = ((tried.pieces - tried.pieces.mean(axis=0)) ** 2).sum(axis=0)
        total = float(np.var(tried.utilities)) * len(tried.utilities)
    return np.array([tried.utility, len(tried.utilities) - 1.0, total, *parts])
