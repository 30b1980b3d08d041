"""Where an effect acts: how much in each step, and whether few trials show it.

An effect of one trial is borne out by no other, however likely it is: nothing says that it was not
that trial which was odd.
"""

from __future__ import annotations

import numpy as np

from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.frozen import Array

MOST = 0.8  # of all that it does, which few trials hold
FEW = 4  # one of so many trials
ALIKE = 0.5  # of what it does in their steps: where others hold as much, no place shows it
MEMORY = 1e-2  # of a memory's spread: what counts as noise there, where there is none


def acting(predictor: Predictor, fit: Fitted, name: str) -> Array:
    """How much an effect does in each step, squared, in units of the noise, (L, B)."""
    data, h, x = predictor.data, fit.hypothesis, fit.track
    less = h.minus(name)
    moved = data.model.difference(predictor.next(less, x[:-1]), predictor.next(h, x[:-1]))
    shown = np.zeros_like(x) + predictor.offset(h, x) - predictor.offset(less, x)
    log_q, log_r = fit.noise.log_q.copy(), fit.noise.log_r.copy()
    for i in data.hidden:  # no noise disturbs it, and by none nothing can be divided
        log_q[i] = log_r[i] = 2 * np.log(MEMORY * data.scales.spread(data.model.state_names[i]))
    square = moved**2 / np.exp(log_q) + shown[1:] ** 2 / np.exp(log_r)
    return np.asarray(square.sum(axis=-1) * data.valid.T)


def few_trials(data: Data, acts: Array) -> int:
    """In how many trials it acts, where those are few and special; else 0."""
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
