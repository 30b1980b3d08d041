"""Whether trials bear an effect out step by step: the finest held-out ruler where noise is white.

A second ahead the noise of many steps has added up, and values of parameters that move beside an
effect are off by chance in all trials alike, which no scatter from trial to trial shows. Where
nothing but white noise is left, one step's prediction, weighed by the filter, is all that there is
to know: its log-likelihood of a trial, at the values that the other trials give.
"""

from __future__ import annotations

import numpy as np

from grounded.diagnosis.hypotheses.explored import CLAIM, FittedHypotheses
from grounded.diagnosis.likelihood.fitted import Fitted, leave_one_out
from grounded.frozen import Array

SAME_SAMPLES = 1e-6  # nats: two fits that a delayed sensor leaves other samples don't compare


def gained(before: Fitted, after: Fitted, folds: Array) -> Array:
    """What each trial's steps are likelier under `after`, values from the others, (S,) [nats].

    Args:
        before: a fit.
        after: another one of the same samples; nothing is gained where they are not the same.
        folds: what each run is held out with, (B,).
    """
    if abs(_constant(before) - _constant(after)) > SAME_SAMPLES * max(abs(after.loglik), 1.0):
        return np.zeros(len(np.unique(folds)))
    return _held_out(after, folds) - _held_out(before, folds)


def borne_out(search: FittedHypotheses, before: Fitted, after: Fitted, folds: Array) -> bool:
    """Whether `after` is worth a claim by single steps, the trial that gains most left out."""
    each = search.tempering.factor * gained(before, after, folds)
    return len(each) > 1 and float(each.sum() - each.max()) > CLAIM


def _held_out(fit: Fitted, folds: Array) -> Array:
    """Log-likelihood of each trial under the values that the others give, but for a constant."""
    rss = leave_one_out(fit, folds)[1]
    return -0.5 * (rss + np.array([fit.logdet[folds == i].sum() for i in np.unique(folds)]))


def _constant(fit: Fitted) -> float:
    """What the samples that are counted add to a log-likelihood, whatever is predicted."""
    return fit.loglik + 0.5 * float(fit.rss.sum() + fit.logdet.sum())
