"""How far the gap shrinks: predictions of trials that had no part in the values.

For each trial the values are estimated from the other trials (one Newton step from the estimate on
all), and the trial is predicted from many of its moments, a second ahead, with the commands that
were really sent. Errors are in units of what noise alone would make of them; 1 is the floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.diagnosis.fitted import Fit, calibrated
from grounded.diagnosis.hypothesis import Hypothesis, Predictor, param_scale
from grounded.diagnosis.intervals import leave_one_out
from grounded.diagnosis.prediction_error import Horizon, errors, normalised
from grounded.frozen import Array


@dataclass(frozen=True, eq=False)
class Shrinkage:
    """Errors of held-out predictions (M, n) before and after, and their sizes."""

    where: Horizon
    before: Array
    after: Array

    @property
    def gap_before(self) -> float:
        """Noise-normalised rms of the model as it is."""
        return normalised(self.before, self.where)

    @property
    def gap_after(self) -> float:
        """The same with the effects, values from the other trials."""
        return normalised(self.after, self.where)


def shrinkage(predictor: Predictor, fit: Fit, bare: Array, where: Horizon) -> Shrinkage:
    """Held-out errors before, from the states `bare` (L + 1, B, n), and after, from its own."""
    before = errors(predictor, Hypothesis(), bare, where)
    return Shrinkage(where, before, held_out(predictor, fit, fit.track, where))


def held_out(predictor: Predictor, fit: Fit, track: Array, where: Horizon) -> Array:
    """Errors of each trial with values from the others, (M, n)."""
    data, h = predictor.data, fit.hypothesis
    if not h.effects and h.spread == 0:
        return errors(predictor, h, track, where)
    shifts, _ = leave_one_out(fit, data.trial_of)
    found = np.full((len(where.at), data.model.n), np.nan)
    of_start = data.trial_of[where.run]
    for trial, shift in zip(np.unique(data.trial_of), shifts, strict=True):
        own = np.flatnonzero(of_start == trial)
        if len(own):
            part = Horizon(where.steps, where.at[own], where.run[own], where.spread[own])
            found[own] = errors(predictor, moved(predictor, h, shift), track, part)
    return found


def moved(predictor: Predictor, h: Hypothesis, shift: Array) -> Hypothesis:
    """A hypothesis with its values and parameters moved by (C,)."""
    k = len(h.theta)
    other = h.with_theta(h.theta + shift[:k])
    if h.spread == 0 or h.shift is None:
        return other
    which = calibrated(predictor.data)
    params = h.shift.copy()
    params[which] += shift[k:] * param_scale(predictor.data.model)[which]
    return replace(other, shift=params)


def whole_runs(predictor: Predictor, h: Hypothesis, track: Array) -> Array:
    """Rms error of each state when runs are predicted from their first state to their end, (n,)."""
    data = predictor.data
    lengths = data.valid.sum(axis=1).astype(int)
    total, count = np.zeros(data.model.n), np.zeros(data.model.n)
    for length in np.unique(lengths):
        runs = np.flatnonzero(lengths == length)
        at = np.zeros(len(runs), int)
        where = Horizon(int(length), at, runs, np.ones((len(runs), data.model.n)))
        for steps in np.unique(np.linspace(length / 4, length, 4).astype(int)):
            part = Horizon(max(int(steps), 1), where.at, where.run, where.spread)
            error = errors(predictor, h, track, part)
            total += np.nansum(error**2, axis=0)
            count += np.isfinite(error).sum(axis=0)
    return np.asarray(np.sqrt(total / np.maximum(count, 1)))


def gaps_of(predictor: Predictor, fits: Sequence[Fit], where: Horizon) -> list[float]:
    """The gap that each of several hypotheses leaves, held out."""
    return [normalised(held_out(predictor, fit, fit.track, where), where) for fit in fits]
