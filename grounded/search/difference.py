"""Difference: is one candidate better than another, by how much, and how sure is that?

Every part that compares two utilities asks it: the verdicts and the end of the search, `status`,
`propose`, the report and the page. Student's t-test with the scatter of all repeats of similar
utility gives the probability. While nothing was repeated, costs are taken to scatter as chi-squared
with eight degrees of freedom.

Few candidates are run more than twice. So the variance of a run is pooled (`Repeats`) over all
repeated candidates of about the same cost: the scatter of a poor policy says nothing about that of
a good one.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from grounded.findings import Finding, Quantity, found
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.search.candidate import DOUBTFUL_GAIN, IMPROVED, Candidate, Tried
from grounded.search.noise import noise_cost, noise_missed, sensor_noise
from grounded.search.planner import Planner, predicted
from grounded.task import Task
from grounded.trial import Trial, scattered

if TYPE_CHECKING:
    from grounded.search.step_size import SearchOptions

LARGEST_COST_RATIO = 2.0  # largest ratio of costs of candidates whose scatter is pooled
LUCK = 2.0  # standard errors that a loss must exceed to break a promise
SHOWN = 1.645  # standard errors of a gain that is one with probability IMPROVED, 0.95
COST_RATIO = 3.44  # ratio of two costs that is no scatter: F(8, 8) exceeds it in 1 of 20 cases


# --- how much runs scatter ------------------------------------------------------------------------


@dataclass(frozen=True)
class Scatter:
    """Variance of a single run's utility, and its degrees of freedom; NaN and 0 if not known."""

    variance: float = math.nan
    freedom: float = 0.0

    def error(self, *runs: int) -> float:
        """Return the standard error of a difference of means of so many runs each."""
        return math.sqrt(self.variance * sum(1 / count for count in runs))


class Repeats:
    """The candidates that were run repeatedly, with their costs and sums of squares."""

    def __init__(self, history: Iterable[Tried]) -> None:
        rows = []
        for one in history:
            runs = len(one.utilities)
            if runs < 2 or not math.isfinite(one.utility):
                continue
            differ = len(set(one.utilities)) > 1  # else exactly 0, which a rounded mean may miss
            with np.errstate(over="ignore", invalid="ignore"):  # diverged runs
                total = float(np.var(one.utilities)) * runs if differ else 0.0
            rows.append((one.utility, runs - 1.0, total))
        found = np.array(rows).reshape(len(rows), 3)
        # identical runs must be copies if others scatter
        self.rows = found[found[:, 2] != 0] if found[:, 2].any() else found

    def near(self, utility: float) -> Scatter:
        """Return the scatter of runs of about this utility; none if all repeats agree exactly."""
        cost, (each, freedom, squares) = abs(utility), np.abs(self.rows.T)
        some = (each <= LARGEST_COST_RATIO * cost) & (cost <= LARGEST_COST_RATIO * each)
        some |= not squares.any()  # then no run scatters, at whatever utility
        nu, total = float(freedom[some].sum()), float(squares[some].sum())
        return Scatter(total / nu, nu) if nu and math.isfinite(total) else Scatter()


# --- what a start state costs ---------------------------------------------------------------------


def worth_of_start(planner: Planner, policy: Policy, off: Array) -> float:
    """Return by how much a start that is off s_0 by `off` (n,) changes the utility in the model.

    True values behind late or filtered logs are off by as much: else the log would soon show the
    robot at s_0. NaN if the model fails from s_0, -inf if it fails from there only.
    """
    from grounded.places import true_values

    problem = planner.feeding_back((policy,)).plan.problem(exact=True)
    moved, names, n = problem.start.copy(), planner.plan.model.state_names, len(off)
    moved[:n] += off
    for memory, logged in true_values(names, names[n:]).items():
        moved[memory] += off[logged]
    with np.errstate(all="ignore"):
        from_there, from_s_0 = (
            predicted(replace(problem, start=start), policy).utility
            for start in (moved, problem.start)
        )
    return float(from_there - from_s_0)


# --- the comparison -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Difference:
    """The difference of the mean utilities of two candidates.

    Args:
        before: a candidate that was run.
        after: another one.
        history: all candidates with their trials, whose repeats tell the scatter.
        pool: these repeats, if they are known.
    """

    before: Tried
    after: Tried
    history: Sequence[Tried]
    pool: Repeats | None = None

    @property
    def gain(self) -> float:
        """By how much the mean utility of `after` exceeds that of `before`, as measured."""
        return self.after.utility - self.before.utility

    @cached_property
    def scatter(self) -> Scatter:
        """The scatter of runs like those of `after`; a poor policy before says little of them."""
        if not (self.before.utilities and self.after.utilities):
            return Scatter()
        return (self.pool or Repeats(self.history)).near(self.after.utility)

    @property
    def known(self) -> bool:
        """Whether repeats tell the error."""
        return self.scatter.freedom > 0

    @property
    def error(self) -> float:
        """Standard error of the gain; NaN if it is not known."""
        return self.scatter.error(len(self.before.utilities), len(self.after.utilities))

    @property
    def likely_error(self) -> float:
        """The same; while nothing was repeated, that of costs which scatter by half of them."""
        if self.known:
            return self.error
        usual = Scatter((0.5 * self.after.utility) ** 2)
        return usual.error(len(self.before.utilities), len(self.after.utilities))

    @cached_property
    def probability(self) -> float:
        """That the later one is better; NaN if repeats can't tell."""
        if not math.isfinite(self.before.utility):  # it failed
            return 1.0
        if not self.known:
            return math.nan
        freedom = self.scatter.freedom
        return student(self.gain / self.error, freedom) if self.error else float(self.gain > 0)

    @property
    def sure(self) -> bool:
        """Whether the gain is one with probability IMPROVED.

        If no repeat tells how much runs scatter: whether it is more than costs usually scatter by.
        """
        sure = self.probability
        if math.isnan(sure):
            return self.before.utility < COST_RATIO * self.after.utility
        return sure >= IMPROVED

    @property
    def lead(self) -> Finding:
        """The share of the cost by which `after` is ahead, or that scatter may explain that."""
        after, before = self.after.candidate.id, self.before.candidate.id
        if self.gain > 0 and not self.sure:
            return found("search.lead", after, before=before)
        cost = abs(self.before.utility)
        return found(
            "search.better",
            after,
            before=before,
            share=abs(self.gain) / cost,
            better=int(self.gain > 0),
            error=self.error / cost,
        )

    def to_finding(self) -> Finding:
        """Return the gain with how certain it is. It asks for no run: that is decided elsewhere."""
        return found(
            "search.gain",
            self.after.candidate.id,
            after=self.after.candidate.id,
            before=self.before.candidate.id,
            gain=Quantity(self.gain, "1", self.error),
            probability=self.probability if self.error > 0 else None,
            single=int(not self.known),
            exact=int(self.known and self.error == 0),
        )


def last_gain(history: Sequence[Tried]) -> Difference | None:
    """Return the last accepted improvement; None before there is one."""
    accepted = [t for t in history if t.accepted]
    return Difference(accepted[-2], accepted[-1], history) if len(accepted) > 1 else None


def one_trial_error(best: Tried, repeats: int = 1) -> float:
    """Return the standard error of a new candidate's gain over the best; 0 if no noise is known."""
    each = Scatter(best.deviation**2)
    return each.error(repeats, len(best.utilities)) if best.deviation > 0 else 0.0


def in_question(made: Candidate, best: Tried, repeats: int = 1) -> Finding | None:
    """Return that a candidate promises less than `SHOWN` errors of its trial's gain; else None."""
    own, gain, cost = best.candidate.id, made.promised_over(best), abs(best.utility)
    luck = SHOWN * one_trial_error(best, repeats) if made.base == own else 0.0
    if not 0 < gain < luck:
        return None
    share = gain / cost if gain < DOUBTFUL_GAIN * cost and not best.is_unsteady else None
    about: dict[str, Any] = {"candidate": made.id, "best": own}
    return found("plan.small", made.id, gain=gain, luck=luck, share=share, **about)


def student(x: float, freedom: float) -> float:
    """Return Student's t distribution, P(T <= x), to 1e-6, without the slow import of scipy.

    T = sqrt(freedom) tan(a), and the density of the angle a goes with cos(a)^(freedom - 1).
    """
    end = math.atan(abs(x) / math.sqrt(freedom))
    density = np.cos(end * (np.arange(2000) + 0.5) / 2000) ** (freedom - 1.0)
    area = math.sqrt(math.pi) * math.exp(math.lgamma(freedom / 2) - math.lgamma((freedom + 1) / 2))
    return 0.5 + math.copysign(float(density.mean()) * end / area, x)


# --- which candidates improved -------------------------------------------------------------------


def judged(
    task: Task,
    candidates: Sequence[Candidate],
    trials: Sequence[Trial],
    options: SearchOptions,
    model: str,
) -> tuple[tuple[Tried, ...], Tried | None, int]:
    """Return every candidate with its trials and verdict, the incumbent, and the iterations.

    A candidate is accepted by measured utilities alone, as in the paper.
    """
    history: list[Tried] = []
    incumbent: Tried | None = None
    iteration = losses = 0  # accepted improvements; steps from the incumbent that did not improve
    exact = False  # whether the system has repeated itself to the last bit
    known, runs = {trial.id for trial in trials}, {one.id: list[Trial]() for one in candidates}
    for trial in trials:
        if trial.candidate in runs:
            runs[trial.candidate].append(trial.whole(task.horizon))
    every = [*chain.from_iterable(runs.values())]
    spent, agree = len(every) >= options.max_trials, not scattered(every)
    for candidate in candidates:
        own = tuple(runs[candidate.id])
        utilities = tuple(map(task.utility, own))
        gone = () if known.issuperset(candidate.seen) else _missing(candidate, known)
        failed = -np.inf in utilities
        exact = exact or (agree and any(one.repeats(other) for one, other in pairwise(own)))
        enough = min(options.repeats, len(own)) if exact and own else options.repeats
        if len(own) < enough and not failed:
            history.append(Tried(candidate, own, utilities, None, gone=gone))
            continue
        tried = Tried(candidate, own, utilities, False, gone=gone)
        better = incumbent is None or tried.utility > incumbent.utility
        if better and not failed:
            tried = replace(tried, accepted=True)
            iteration += incumbent is not None
            incumbent, losses = tried, 0
            # a loss that was in doubt is one: this candidate beat both runs
            for k, one in enumerate(history):
                if one.in_doubt:
                    history[k] = replace(one, accepted=False, in_doubt=False)
        elif incumbent is not None and (candidate.base, candidate.model) == (
            incumbent.candidate.id,
            model,
        ):
            losses += 1
            doubts = options.rerun_incumbent and not (spent or exact)
            if doubts and in_doubt(incumbent, tried, history, losses + options.repeats):
                tried = replace(tried, accepted=None, in_doubt=True)
        history.append(tried)
    told = _told(task, history, trials)
    best = None
    for tried in told if incumbent else ():
        best = tried if incumbent and tried.candidate is incumbent.candidate else best
    return told, best, iteration


def _missing(candidate: Candidate, known: Container[str]) -> tuple[str, ...]:
    """Return the trials that a candidate was made from and that are not known any more."""
    return tuple(one for one in candidate.seen if one not in known)


def _told(task: Task, history: Sequence[Tried], trials: Sequence[Trial]) -> tuple[Tried, ...]:
    """Return the candidates with the noise in their logs, their scatter, and how sure gains are."""
    pool, noise = Repeats(history), sensor_noise(trials, task.model.n)
    found, best = list[Tried](), None
    for tried in history:
        made = tried.candidate
        tried = replace(
            tried,
            noise_missed=noise_missed(task, made, noise),
            noise_cost=noise_cost(task, made.policy, noise) if tried.trials else 0.0,
            deviation=math.sqrt(pool.near(tried.utility).variance),
        )
        found.append(with_chance(tried, best, history, pool))
        best = tried if tried.accepted else best
    return tuple(found)


def with_chance(tried: Tried, best: Tried | None, history: Sequence[Tried], pool: Repeats) -> Tried:
    """Return a candidate; an improvement on the best before it gets the probability that it is."""
    if not tried.accepted or best is None:
        return tried
    gained = Difference(best, tried, history, pool)
    return replace(tried, probability=gained.probability, unsure=not gained.sure)


def in_doubt(incumbent: Tried, loser: Tried, history: Sequence[Tried], most: int) -> bool:
    """Return whether a loss may be due to a lucky trial of the incumbent.

    A lucky incumbent would block every further step. So after a loss within two standard errors it
    is run again, until it has `most` trials: one for each loss. Without repeats at a similar
    utility a loss of more than 1.4 times the best cost is accepted at once
    (`Difference.likely_error`). On a deterministic system this costs one trial per incumbent.
    """
    if not np.isfinite(loser.utility) or len(incumbent.trials) >= most:
        return False
    lead = Difference(loser, incumbent, (*history, loser))
    return not lead.gain > LUCK * lead.likely_error
