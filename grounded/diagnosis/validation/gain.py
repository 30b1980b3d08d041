"""Gain in prediction accuracy of one hypothesis over another, with its standard error.

The gain is the mean log ratio of rms errors over channels and horizons; its standard error is the
jackknife's over trials (in a single log, over the runs that it is cut into). Runs differ in how
much of an effect they contain: if two of eight trials show all of it, the gain is 1.5 standard
errors even without noise. So the short horizons are also compared in pieces of a second, where a
piece in which the effect does not act adds neither gain nor scatter (`Gain.again`), and single
channels are looked at, since an effect on one would be lost in the mean over a dozen.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from grounded.diagnosis.levels import LEAST, SURE
from grounded.frozen import Array


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
    """Improvement of one hypothesis over another: mean log ratio of errors, and how sure it is."""

    mean: float
    scatter: float  # its jackknife standard error
    largest: float  # of any channel and horizon
    channels: Array  # (n',) mean over horizons, by shown state
    scatters: Array  # (n',) standard errors of these
    again: float  # gain of all pieces but those of the best trial, in scatters of their sum
    whole: tuple[float, float] = (0.0, 0.0)  # gain over whole trials and its standard error

    @property
    def ruins(self) -> bool:
        """Whether predictions of whole trials are clearly worse."""
        return self.whole[0] < -max(SURE * self.whole[1], LEAST)

    @property
    def clear(self) -> bool:
        """Whether predictions are clearly better."""
        return self.mean > SURE * self.scatter and self.largest > LEAST

    @property
    def pays(self) -> bool:
        """Whether predictions are better: clearly, or twice as surely again and again or in one."""
        one = (self.channels > 2 * SURE * self.scatters) & (self.channels > LEAST)
        several = self.mean > 0 and (self.again > 2 * SURE or bool(one.any()))
        return self.clear or (several and self.largest > LEAST)


@dataclass(frozen=True, eq=False)
class Comparison:
    """How errors of two hypotheses on the same trials are compared.

    Args:
        shown: (n',) states that are compared.
        matters: (K, n') errors below which differences do not matter.
        unit: (P,) jackknife unit of each piece: its trial, or in a single log its run.
    """

    shown: Any
    matters: Array
    unit: Any

    def __call__(self, before: Errors, after: Errors) -> Gain:
        """Return the gain of one set of errors over another."""
        a, b = (self._by_unit(errors.total) for errors in (before, after))
        count = self._by_unit(before.count).sum(axis=1, keepdims=True)
        seen, least = count > 0, count * self.matters[:, None] ** 2 + 1e-300

        def ratio(x: Array, y: Array) -> Array:
            return np.asarray(np.where(seen, 0.5 * np.log((x + least) / (y + least)), 0.0))

        def without(x: Array) -> Array:
            return np.asarray(np.maximum(x.sum(axis=1, keepdims=True) - x, 0.0))

        whole = ratio(a.sum(axis=1, keepdims=True), b.sum(axis=1, keepdims=True))
        counts = np.maximum(seen.sum(axis=(0, 1)), 1)
        each, some = ratio(without(a), without(b)), max(int(seen.sum()), 1)
        by, last = each.sum(axis=0), max(int(seen[-1].sum()), 1)
        return Gain(
            float(whole.sum() / some),
            float(_jackknife(by.sum(axis=-1) / some)),
            float(whole.max()),
            whole.sum(axis=(0, 1)) / counts,
            _jackknife(by / counts),
            self._again(before, after),
            (float(whole[-1].sum() / last), float(_jackknife(each[-1].sum(axis=-1) / last))),
        )

    def _by_unit(self, values: Array) -> Array:
        """Return sums over pieces by unit, (K, U, n') of (K, P, n)."""
        found = np.zeros((len(values), int(self.unit.max()) + 1, len(self.shown)))
        for k, one in enumerate(values[..., self.shown]):
            np.add.at(found[k], self.unit, one)
        return found

    def _again(self, before: Errors, after: Errors) -> float:
        """Return the gain of the pieces without the best unit, in scatters of their sum.

        Each is damped by the mean error, so that none dominates.
        """
        a, b, n = (e[:-1][..., self.shown] for e in (before.total, after.total, before.count))
        count = np.maximum(n.sum(axis=1, keepdims=True), 1)
        usual = n * (b.sum(axis=1, keepdims=True) / count + self.matters[:-1, None] ** 2) + 1e-300
        pieces = (n / count * np.log((a + usual) / (b + usual))).sum(axis=(0, 2))
        by = np.bincount(self.unit, pieces)
        rest = pieces[self.unit != int(by.argmax())]
        scatter = np.sqrt(len(rest) * rest.var()) if len(rest) > 1 else 0.0
        return float(rest.sum() / scatter) if scatter > 0 else 0.0


def _jackknife(each: Array) -> Array:
    """Return the jackknife standard error from the means without each unit, (U, ...) -> (...)."""
    count = len(each)
    if count < 2:
        return np.full(each.shape[1:], np.inf)
    return np.asarray(np.sqrt((count - 1) / count * ((each - each.mean(axis=0)) ** 2).sum(axis=0)))
