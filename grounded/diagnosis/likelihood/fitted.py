"""A hypothesis at its most likely values, as `refine` returns it; see `intervals` for `+-`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.noise import NoiseModel
from grounded.frozen import Array

UNSEEN = 1e-4  # share of a value's information that must lie outside of what is held out


@dataclass(frozen=True, eq=False)
class Fitted:
    """A hypothesis at its most likely values.

    Per run (B): `gram` (B, C, C), `score` (B, C), `rss` (B,), `logdet` (B,) of the whitened columns
    in the order [effects' free values, shifts]; `white` (L, B, n) are the whitened innovations.
    `states` equals the track unless the model has kinks. There the track may have been held during
    the fit, and be nearly as noisy as the measurements.
    """

    hypothesis: Hypothesis
    noise: NoiseModel
    track: Array  # (L + 1, B, n) about which it is linearised
    loglik: float  # log-likelihood of the data
    peak: float  # loglik and the log prior of the shifts: what a fit climbs
    evidence: float  # log p(y | h), the shifts integrated out
    gram: Array
    score: Array
    rss: Array
    logdet: Array
    white: Array
    states: Array  # (L + 1, B, n) filtered states, which predictions start from
    settled: bool = False  # converged: a fit that starts here ends here
    fine: bool = False  # converged as far as it goes, see `polish`

    @property
    def covariance(self) -> Array:
        """Covariance of the free values and shifts, (C, C), from the Fisher information."""
        G = self.gram.sum(axis=0) + np.diag(self.prior)
        return np.linalg.pinv(G, hermitian=True)

    def prior_pull(self, data: Data) -> Array:
        """Return the slope of the negative log prior at the current shifts, (C,)."""
        h, pull = self.hypothesis, np.zeros(self.gram.shape[-1])
        k = len(h.theta)
        if h.shift is not None and len(pull) > k:
            which = calibrated(data)
            pull[k:] = self.prior[k:] * h.shift[which] / data.model.spreads[which]
        return pull

    @property
    def prior(self) -> Array:
        """Prior precision of each unknown, (C,): zero for values of effects."""
        h = self.hypothesis
        k = len(h.theta)
        return np.concatenate([np.zeros(k), shift_precision(h, self.gram.shape[-1] - k)])


def shift_precision(h: Hypothesis, count: int) -> Array:
    """Return the prior precision of the parameters' shifts (count,), in units of their scale."""
    return np.full(count, 1.0 / h.spread**2) if count else np.zeros(0)


def calibrated(data: Data) -> Any:
    """Return the indices of the uncertain parameters, those with a scale, which may be shifted."""
    return np.flatnonzero(data.model.spreads > 0)


def moved(data: Data, h: Hypothesis, delta: Array) -> Hypothesis:
    """Return a hypothesis moved by delta (C,): values, then shifts in units of their scale."""
    k = len(h.theta)
    other = h.with_theta(h.theta + delta[:k])
    if len(delta) == k:
        return other
    which = calibrated(data)
    shift = np.zeros(data.model.system.k) if h.shift is None else h.shift.copy()
    shift[which] += delta[k:] * data.model.spreads[which]
    return replace(other, shift=shift)


def leave_one_out(fit: Fitted, fold: Array, unseen: float = UNSEEN) -> Array:
    """Return the changes of all values without each fold, (S, C).

    One Newton step each: theta_{-i} = theta + (G - G_i)^-1 s_i. What only the fold itself shows
    returns to the value at which its effect vanishes, so that it predicts nothing there: a weak
    prior does that, `unseen` of the information of all folds.
    """
    names, h = np.unique(fold), fit.hypothesis
    C, total = fit.gram.shape[-1], fit.gram.sum(axis=0)
    size, weak = np.zeros(C), np.zeros(C)
    for k in (k for own in h.sizes for k in own):
        size[k] = h.theta[k] - [q.start for e in h.effects for q in e.free][k]
        weak[k] = unseen * total[k, k]
    shifts = np.zeros((len(names), C))
    for i, name in enumerate(names):
        own = fold == name
        G, s = fit.gram[own].sum(axis=0), fit.score[own].sum(axis=0)
        if C and len(names) > 1:
            A = total - G + np.diag(fit.prior + weak)
            scale = 1 / np.sqrt(np.maximum(np.diag(A), 1e-300))
            scaled = A * np.outer(scale, scale)
            pull = scale * (s - weak * size)
            shifts[i] = scale * np.linalg.lstsq(scaled, pull, rcond=1e-8)[0]
    return shifts
