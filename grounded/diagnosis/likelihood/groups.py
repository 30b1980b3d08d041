"""Groups of trials that differ in motion or in condition, made before any effect is looked at.

Values are fitted without a group and predict it. So a number that is free for each level of an
input can't win by fitting levels, and what one motion shows is not confirmed by its repeats.

Two trials are of one group if every input, and every state that the rates may depend on, is nearly
the same function of time in both: in means over tenths of the trial, so that noise or a chattering
feedback does not make motions different. A user may name groups instead (`Trial.group`): a wet and
a dry floor, say, which no signal shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from grounded.diagnosis.levels import ALIKE
from grounded.frozen import Array

REPEATS = 0.03  # fraction of a signal's power below which two trials make the same motion
TENTHS = 10  # stretches whose means are compared
MOTION, LEVEL = 1 / 3, 0.5  # most of all steps that are left out together, see `folds`
MOST_FOLDS = 20


@dataclass(frozen=True)
class Group:
    """Trials of one motion in one condition, and the signals with levels of their own there."""

    trials: tuple[int, ...]
    differs_in: tuple[str, ...] = ()


class Signals:
    """What groups are made of: inputs and dynamic states of each trial, in means over tenths.

    Args:
        names: the k signals.
        each: one array (T, k) for each trial, without NaN.
        named: the group that the user named for each trial; "" for none.
    """

    def __init__(self, names: Sequence[str], each: Sequence[Array], named: Sequence[str]) -> None:
        self.names, self.named = tuple(names), np.array(named)
        self.lengths = np.array([len(one) for one in each])
        self.means = np.stack([_tenths(one) for one in each])  # (S, TENTHS, k)
        self.power = (self.means**2).mean(axis=(0, 1))
        self.moves = self.means.var(axis=(0, 1)) > 1e-9 * self.power

    def group_of(self) -> Any:
        """Return the group of each trial, (S,) of int: alike, directly or by way of others."""
        from scipy.sparse.csgraph import connected_components

        return connected_components(np.array([self._like(i) for i in range(len(self.means))]))[1]

    def groups(self) -> list[Group]:
        """Return the groups in the order of their first trials."""
        of = self.group_of()
        found = [np.flatnonzero(of == k) for k in range(int(of.max()) + 1)]
        return [Group(tuple(own.tolist()), self._apart(own)) for own in found]

    def _like(self, i: int) -> Any:
        """Return which trials belong to the same group as trial i, (S,) of bool."""
        apart = 0.5 * ((self.means - self.means[i]) ** 2).mean(axis=1)
        same = (apart <= REPEATS * self.power)[:, self.moves].all(axis=1)
        longer = np.maximum(self.lengths, self.lengths[i])
        same &= longer <= (1 + ALIKE) * np.minimum(self.lengths, self.lengths[i])
        named = (self.named != "") | (self.named[i] != "")
        return np.where(named, self.named == self.named[i], same)

    def _apart(self, own: Any) -> tuple[str, ...]:
        """Return the signals whose range in some trials overlaps that in none of the others."""
        low, high = self.means.min(axis=1), self.means.max(axis=1)
        others_low, others_high = np.delete(low, own, axis=0), np.delete(high, own, axis=0)
        if not len(others_low):
            return ()
        above = others_low > high[own].max(axis=0)
        below = others_high < low[own].min(axis=0)
        far = self.moves & (above | below).all(axis=0)
        return tuple(name for name, differs in zip(self.names, far, strict=True) if differs)


def folds(group: Any, trial: Any, steps: Any, levels: Any) -> Any:
    """Return the fold of each run, (B,) of int: the runs that are held out together.

    A fold is a group. Leaving out too much would have the rest extrapolate: a group with more than
    MOTION of all steps (LEVEL, if it has levels of its own, which are to be foretold) is held out
    trial by trial, and such a trial in pieces (its runs). Many small groups form a fold together.

    Args:
        group: the group of each run (B,).
        trial: its trial (B,).
        steps: its number of steps (B,).
        levels: whether its group has levels of its own (B,).
    """
    steps = np.asarray(steps, float) / max(float(np.sum(steps)), 1.0)
    fold, most = np.asarray(group), np.where(levels, LEVEL, MOTION)
    for finer in (trial, np.arange(len(fold))):
        whole = np.bincount(fold, steps)[fold]
        apart = whole > most
        fold = np.where(apart, fold.max() + 1 + np.asarray(finer), fold)
        most = np.where(apart, MOTION, most)
    fold = np.unique(fold, return_inverse=True)[1]
    count, pieces = int(fold.max()) + 1, len(np.unique(trial)) == 1
    return fold if pieces or count <= MOST_FOLDS else fold * MOST_FOLDS // count


def _tenths(values: Array) -> Array:
    """Return means over tenths of the time, (TENTHS, k) of (T, k)."""
    edges = np.linspace(0, len(values), TENTHS + 1).astype(int)
    return np.stack([values[a : max(b, a + 1)].mean(axis=0) for a, b in pairwise(edges)])
