"""How strongly an effect acts in each step, and whether only few trials show it.

An effect that acts in a single trial is not supported by any other, however likely it is: that
trial may simply have been unusual.
"""

from __future__ import annotations

import numpy as np

from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.frozen import Array

MOST = 0.8  # fraction of its action that few trials must hold
FEW = 4  # few means at most one of this many trials
ALIKE = 0.5  # if the other trials have more than this part of their action per step: not special
MEMORY = 1e-2  # fraction of a memory state's spread that stands in for its noise, which is zero


def acting(predictor: Predictor, fit: Fitted, name: str) -> Array:
    """Return the squared change of each step by an effect, relative to the noise, (L, B)."""
    data, h, x = predictor.data, fit.hypothesis, fit.track
    less = h.minus(name)
    moved = data.model.difference(predictor.next(less, x[:-1]), predictor.next(h, x[:-1]))
    shown = np.zeros_like(x) + predictor.offset(h, x) - predictor.offset(less, x)
    log_q, log_r = fit.noise.log_q.copy(), fit.noise.log_r.copy()
    for i in data.hidden:  # its noise is zero, by which nothing can be divided
        log_q[i] = log_r[i] = 2 * np.log(MEMORY * data.scales.spread(data.model.state_names[i]))
    square = moved**2 / np.exp(log_q) + shown[1:] ** 2 / np.exp(log_r)
    return np.asarray(square.sum(axis=-1) * data.valid.T)


def few_trials(data: Data, acts: Array) -> int:
    """Return the number of trials in which an effect acts, if those are few and special; else 0."""
    by = np.bincount(data.trial_of, acts.sum(axis=0), data.count)
    steps = np.bincount(data.trial_of, data.valid.sum(axis=1), data.count)
    order = np.argsort(-by)
    held = np.cumsum(by[order])
    few = 1 + int(np.searchsorted(held, MOST * held[-1]))
    if not held[-1] > 0 or few > max(data.count // FEW, 1) or few == data.count:
        return 0
    there, rest = order[:few], order[few:]
    alike = by[rest].sum() * steps[there].sum() > ALIKE * by[there].sum() * steps[rest].sum()
    return 0 if alike else few  # the few are long, not special
