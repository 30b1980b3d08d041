"""Gain: what one hypothesis predicts better than another, and whether that is chance.

Two hypotheses are compared by the mean logarithm of the ratio of their errors over channels and
horizons; its scatter is the jackknife's over runs. Runs differ most in how much of an effect they
hold: what two trials of eight show in full is 1.5 of that scatter, and would be with no noise at
all. So the short horizons are also compared piece by piece of a second: where an effect is not
visited they add nothing, neither gain nor scatter. And the sums are those of the runs that miss
most: of a pendulum that once came to a halt near the top one run makes most of them, and of their
scatter. So every trial is also asked by itself, and all count alike.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from grounded.frozen import Array

AGAIN = 2.0  # scatters that a gain has without its best trial, where it was seen again
CHANCE = 0.01  # of what trials gain by themselves, below which it is no chance


@dataclass(frozen=True, eq=False)
class Errors:
    """Sums of squared errors and their counts by horizon, piece and state, (K, P, n) each."""

    total: Array
    count: Array

    @cached_property
    def rms(self) -> Array:
        """By horizon and state, (K, n); NaN where nothing was measured."""
        total, count = self.total.sum(axis=1), self.count.sum(axis=1)
        return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


@dataclass(frozen=True)
class Gain:
    """What one hypothesis predicts better than another: log ratio of errors, and its scatter."""

    mean: float
    scatter: float
    largest: float  # of a single channel and horizon
    channels: Array  # (n',) the mean over horizons by shown state
    scatters: Array  # (n',) of these
    pieces: Array = field(default_factory=lambda: np.zeros(0))  # (P,) gained in each, up to 1 s
    trial: Array = field(default_factory=lambda: np.zeros(0, int))  # (P,) that it is of
    own: Array = field(default_factory=lambda: np.zeros(0))  # (S,) what each trial gains by itself

    @property
    def chance(self) -> float:
        """That trials which gain nothing gain as much on average, each by itself (Student's t)."""
        from scipy.special import stdtr

        count, spread = len(self.own), float(self.own.std(ddof=1)) if len(self.own) > 1 else 0.0
        if not spread > 0:
            return 1.0
        return float(stdtr(count - 1, -float(self.own.mean()) * np.sqrt(count) / spread))

    @property
    def again(self) -> float:
        """What pieces gain without the trial that gains most, in the scatters of their sum."""
        by = np.bincount(self.trial, self.pieces) if len(self.pieces) else np.zeros(1)
        each = self.pieces[self.trial != int(by.argmax())]
        scatter = np.sqrt(len(each) * each.var()) if len(each) > 1 else 0.0
        return float(each.sum() / scatter) if scatter > 0 else 0.0

    def beyond(self, scatters: float, least: float) -> bool:
        """Whether it is more than its scatter in all."""
        return self.mean > scatters * self.scatter and self.largest > least

    def pays(self, scatters: float, least: float) -> bool:
        """Whether it is worth a claim: in all, without its best trial, by trial, or in one channel.

        There by a scatter more: an effect of one channel is lost in the mean over a dozen, and in
        their scatter.
        """
        one = (self.channels > (scatters + 1) * self.scatters) & (self.channels > least)
        again = (self.again > AGAIN or self.chance < CHANCE) and self.largest > least
        return self.beyond(scatters, least) or (self.mean > 0 and (again or bool(one.any())))
