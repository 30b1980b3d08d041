"""Difference: is one candidate better than another, by how much, and how sure is that?

Every part that compares two utilities asks it: the verdicts and the end of the search, `status`,
`propose`, the report and the page. Single runs scatter (`scatter`), and they begin at different
start states, whose part of a difference the models tell (`starts`). Student's t-test with the
scatter of all repeats of similar utility gives the probability. While nothing was repeated, costs
are taken to scatter as chi-squared with eight degrees of freedom.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np

from grounded.findings import Finding, Quantity, found
from grounded.search.candidate import DOUBTFUL_GAIN, IMPROVED, START_SHARE, Candidate, Tried
from grounded.search.scatter import Repeats, Scatter

LUCK = 2.0  # standard errors that a loss must exceed to break a promise
SHOWN = 1.645  # standard errors of a gain that is one with probability IMPROVED, 0.95
COST_RATIO = 3.44  # ratio of two costs that is no scatter: F(8, 8) exceeds it in 1 of 20 cases
FEW_REPEATS = 8  # repeats below which a scatter may be off by half, so that their number is told


class Doubt(StrEnum):
    """What may explain that a candidate is ahead of another."""

    NONE = ""
    SCATTER = "scatter"  # that of repeats
    STARTS = "starts"  # where the runs began
    UNKNOWN = "unknown"  # nothing was repeated, so how much runs scatter is not known


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

    @property
    def own(self) -> float:
        """The part of the gain that is not due to different start states."""
        return self.gain - self.owed

    @cached_property
    def repeats(self) -> Repeats:
        """All repeats in the history."""
        return self.pool or Repeats(self.history)

    @cached_property
    def scatter(self) -> Scatter:
        """The scatter of runs of about the later one's utility."""
        return self.repeats.near(self.after.utility)

    @property
    def few(self) -> int | None:
        """On how few repeats the scatter rests; None if they are enough, or there are none."""
        return few(self.scatter.repeats)

    @property
    def known(self) -> bool:
        """Whether repeats tell the error."""
        return self.freedom > 0

    @property
    def error(self) -> float:
        """Standard error of the gain; NaN if it is not known."""
        return self._spread[0]

    @property
    def likely_error(self) -> float:
        """The standard error if `before` scatters as `after` does, since a poor policy says little.

        While nothing was repeated, by half of the cost, as chi-squared with eight degrees of
        freedom does.
        """
        near, cost = self.scatter, abs(self.after.utility)
        runs = 1 / len(self.before.utilities) + 1 / len(self.after.utilities)
        return math.sqrt(runs * near.variance) if near.known else 0.5 * cost * math.sqrt(runs)

    @property
    def freedom(self) -> float:
        """Degrees of freedom of the error; 0 if it is not known."""
        return self._spread[1]

    @cached_property
    def _spread(self) -> tuple[float, float]:
        """Standard error and degrees of freedom; of different estimates as in Welch (1947).

        If no repeats are near the earlier candidate, the scatter of the later one is used for both.
        """
        later, runs = self.scatter, (len(self.before.utilities), len(self.after.utilities))
        if not (later.known and all(runs)):
            return math.nan, 0.0
        earlier = self.repeats.near(self.before.utility)
        earlier = earlier if earlier.known else later
        squares = earlier.error(runs[0]) ** 2, later.error(runs[1]) ** 2
        error = math.sqrt(sum(squares))
        if earlier == later or not error:
            return error, later.freedom
        parts = squares[0] ** 2 / earlier.freedom + squares[1] ** 2 / later.freedom
        return error, error**4 / parts

    @cached_property
    def of_start(self) -> float:
        """The part of the gain that is due to the start by the planning model; NaN if unknown."""
        starts = self.after.starts
        return 0.0 if starts is None else starts.owed(self.after, self.before)

    @property
    def owed(self) -> float:
        """How much of the gain is due to different start states; 0 if it is a small part."""
        start = self.of_start
        return start if abs(start) > START_SHARE * abs(self.gain) and math.isfinite(start) else 0.0

    @property
    def apart(self) -> bool:
        """Whether they began apart, and no model tells what that is worth."""
        return math.isnan(self.of_start)

    @property
    def probability(self) -> float:
        """That the later one is better, start states apart; NaN if repeats or models can't tell."""
        if not math.isfinite(self.before.utility):  # it failed
            return 1.0
        own = self.own
        if not self.freedom or (self.error and self.apart):
            return math.nan
        return student(own / self.error, self.freedom) if self.error else float(own > 0)

    @property
    def clear(self) -> bool:
        """Whether the gain is one although no repeat tells how much runs scatter."""
        if not math.isfinite(self.before.utility):  # it failed
            return True
        return self.before.utility < COST_RATIO * (self.after.utility - self.owed)

    @property
    def doubt(self) -> Doubt:
        """What may explain the gain: none if it is one with probability IMPROVED, or `clear`."""
        sure = self.probability
        if sure < IMPROVED:
            by_scatter = student(self.gain / self.error, self.freedom) if self.error else 0.0
            return Doubt.STARTS if by_scatter >= IMPROVED else Doubt.SCATTER
        if math.isnan(sure) and not self.clear:
            whole = self.before.utility < COST_RATIO * self.after.utility
            return Doubt.STARTS if whole else Doubt.UNKNOWN
        return Doubt.NONE

    @property
    def open(self) -> bool:
        """Whether less than its error is left of the gain without the part of the start states."""
        return not self.own > SHOWN * (self.error if self.freedom else 0.0)

    @property
    def lead(self) -> Finding:
        """The share of the cost by which `after` is ahead, or what may explain that it is."""
        after, before = self.after.candidate.id, self.before.candidate.id
        if self.gain > 0 and (doubt := self.doubt):
            return found("search.lead", after, doubt=doubt.value, before=before)
        cost = abs(self.before.utility)
        return found(
            "search.better",
            after,
            before=before,
            share=abs(self.gain) / cost,
            better=int(self.gain > 0),
            error=self.error / cost,
            few=self.few if self.error else None,
            start=abs(self.owed) / cost,
        )

    def to_finding(self) -> Finding:
        """Return the gain with how certain it is. It asks for no run: that is decided elsewhere."""
        told = self.known and not self.owed and not self.apart and self.error > 0
        return found(
            "search.gain",
            self.after.candidate.id,
            after=self.after.candidate.id,
            before=self.before.candidate.id,
            gain=Quantity(self.gain, "1", self.error),
            probability=self.probability if told else None,
            few=self.few if told else None,
            start=self.owed or None,
            own=self.own,
            open=int(bool(self.owed) and self.open),
            apart=int(self.apart and self.error > 0),
            single=int(not self.known and not self.owed),
            exact=int(self.known and self.error == 0 and not self.owed),
        )


def last_gain(history: Sequence[Tried]) -> Difference | None:
    """Return the last accepted improvement; None before there is one."""
    accepted = [t for t in history if t.accepted]
    return Difference(accepted[-2], accepted[-1], history) if len(accepted) > 1 else None


def few(repeats: int) -> int | None:
    """Return on how many repeats a scatter rests if it may be far off; else None."""
    return repeats if 0 < repeats < FEW_REPEATS else None


def one_trial_error(best: Tried, repeats: int = 1) -> float:
    """Return the standard error of a new candidate's gain over the best; 0 if no noise is known."""
    each = best.deviation
    return each * math.sqrt(1 / repeats + 1 / len(best.utilities)) if each > 0 else 0.0


def in_question(made: Candidate, best: Tried, repeats: int = 1) -> Finding | None:
    """Return that a candidate promises less than its trial, or its model, can tell; None if not.

    A gain below `SHOWN` standard errors may be luck, and one below the model's likely error may be
    none.
    """
    own = best.candidate.id
    luck = SHOWN * one_trial_error(best, repeats) if made.base == own else 0.0
    error = made.likely_off if made.doubtful else 0.0
    gain, cost = made.promised_over(best), abs(best.utility)
    if not (made.doubtful or 0 < gain < luck):
        return None
    little = 0 < gain < DOUBTFUL_GAIN * cost and not best.is_unsteady
    return found(
        "plan.small",
        made.id,
        candidate=made.id,
        best=own,
        gain=gain,
        luck=luck if luck >= error else None,
        few=few(best.repeats) if luck >= error else None,
        error=error if error > luck else None,
        share=gain / cost if little else None,
    )


def missed_by_start(tried: Tried) -> float:
    """Return what the starts of a candidate's runs cost by the model; 0 if that is a small part.

    A part of what they missed its prediction by, which begins at [task] start. 0 if the model can't
    tell it, too.
    """
    if tried.starts is None or not tried.trials or not math.isfinite(tried.utility):
        return 0.0
    cost = tried.starts.cost(tried)
    small = abs(cost) < START_SHARE * abs(tried.promised - tried.utility)
    return 0.0 if small or not math.isfinite(cost) else cost


def student(x: float, freedom: float) -> float:
    """Return Student's t distribution, P(T <= x), to 1e-5, without the slow import of scipy.

    T = sqrt(freedom) tan(a), and the density of the angle a goes with cos(a)^(freedom - 1).
    """
    angles = np.linspace(0.0, math.pi / 2, 20_001)
    density = np.cos((angles[1:] + angles[:-1]) / 2) ** (freedom - 1.0)
    within = np.append(0.0, np.cumsum(density)) / density.sum()
    reached = np.interp(math.atan(abs(x) / math.sqrt(freedom)), angles, within)
    return 0.5 + math.copysign(0.5, x) * float(reached)
