"""Gain in prediction accuracy of one hypothesis over another, with tests of its significance.

The gain is the mean log ratio of rms errors over channels and horizons; its scatter is the
jackknife standard error over runs. Two further tests correct weaknesses of this measure:

- Runs differ in how much of an effect they contain. If two of eight trials show all of it, the gain
  is 1.5 of its scatter even without noise. So the short horizons are also compared in pieces of a
  second; pieces where the effect does not act add neither gain nor scatter (`again`).
- The runs with the largest errors dominate the sums and their scatter, such as that of a pendulum
  that once stopped near the top. So each trial's gain is also computed separately, and all trials
  count equally (`chance`).

In a single log, the runs that it is cut into take the place of trials in both.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from grounded.frozen import Array

MOST, FEW = 0.8, 4  # one of FEW trials that holds MOST of what trials gain stands alone
AGAIN = 2.0  # scatters that the gain of all pieces must have without the best trial
CLEAR = 0.1  # log gain of a trial (10 % smaller errors) from which it shows an effect
BETTER = (2.0, 0.05)  # scatters and log gain by which a less likely rival must predict better
CHANCE = 0.01  # p-value of the gains of single trials below which they are significant


@dataclass(frozen=True, eq=False)
class Errors:
    """Sums of squared errors and their counts by horizon, piece and state, (K, P, n) each."""

    total: Array
    count: Array

    @cached_property
    def rms(self) -> Array:
        """Rms errors by horizon and state, (K, n); NaN where nothing was measured."""
        total, count = self.total.sum(axis=1), self.count.sum(axis=1)
        return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


@dataclass(frozen=True)
class Gain:
    """Improvement of one hypothesis over another: log ratio of errors, and its scatter."""

    mean: float
    scatter: float
    largest: float  # of any channel and horizon
    channels: Array  # (n',) mean over horizons, by shown state
    scatters: Array  # (n',) scatter of these
    pieces: Array = field(default_factory=lambda: np.zeros(0))  # (P,) of each piece, up to 1 s
    trial: Array = field(default_factory=lambda: np.zeros(0, int))  # (P,) trial of each piece
    own: Array = field(default_factory=lambda: np.zeros(0))  # (S,) of each trial separately
    single: bool = False  # there is one trial only, whose runs count as the trials

    @property
    def chance(self) -> float:
        """One-sided p-value of the mean gain of single trials (Student's t)."""
        from scipy.special import stdtr

        count, spread = len(self.own), float(self.own.std(ddof=1)) if len(self.own) > 1 else 0.0
        if not spread > 0:
            return 1.0
        return float(stdtr(count - 1, -float(self.own.mean()) * np.sqrt(count) / spread))

    @property
    def again(self) -> float:
        """Gain of all pieces without the best trial, in scatters of their sum."""
        by = np.bincount(self.trial, self.pieces) if len(self.pieces) else np.zeros(1)
        each = self.pieces[self.trial != int(by.argmax())]
        scatter = np.sqrt(len(each) * each.var()) if len(each) > 1 else 0.0
        return float(each.sum() / scatter) if scatter > 0 else 0.0

    @property
    def alone(self) -> int | None:
        """The trial, by its place in `own`, that makes nearly all of the gain; None if none does.

        Few trials need show an effect (a free swing among driven runs). Its gain there is as large
        as its scatter, so it can't be told from chance, but it is not nothing either.
        """
        gains = np.maximum(self.own, 0.0)
        if self.single or len(gains) < FEW or not self.mean > 0:
            return None
        best = int(gains.argmax())
        return best if gains[best] > max(MOST * gains.sum(), CLEAR) else None

    def beyond(self, scatters: float, least: float) -> bool:
        """Check whether the gain exceeds `scatters` of its scatter, and `least` in some channel."""
        return self.mean > scatters * self.scatter and self.largest > least

    def pays(self, scatters: float, least: float) -> bool:
        """Check whether the gain supports a claim.

        It does if it is significant over all channels, in pieces without the best trial, by single
        trials, or in one channel. The last needs one scatter more; without it, an effect on one
        channel would be lost in the mean over a dozen channels and in their scatter.
        """
        one = (self.channels > (scatters + 1) * self.scatters) & (self.channels > least)
        again = (self.again > AGAIN or self.chance < CHANCE) and self.largest > least
        return self.beyond(scatters, least) or (self.mean > 0 and (again or bool(one.any())))
