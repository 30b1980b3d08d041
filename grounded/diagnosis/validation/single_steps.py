"""Leave-one-trial-out test of an effect by one-step likelihoods.

Predictions a second ahead contain the accumulated noise of many steps. Also, errors of parameters
fitted beside an effect are common to all trials and do not show in the scatter between them. If the
innovations are white, the likelihood of single steps contains all information. So each trial is
left out in turn, and the others alone must claim the effect. Both hypotheses use the noise of the
fit with the effect. With its own noise, the fit without the effect would have a larger variance
because of a single trial, and all the other trials would appear to gain.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from grounded.diagnosis.hypotheses.explored import CLAIM, FittedHypotheses
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.refine import refine
from grounded.diagnosis.validation.ruler import folds
from grounded.frozen import Array

SAME_SAMPLES = 1e-6  # relative difference of the constants of two log-likelihoods on the same data


def borne_out(
    search: FittedHypotheses, before: Fitted, after: Fitted, least: float = CLAIM
) -> bool:
    """Check whether the trials claim `after` over `before` even without any single one of them.

    least: nats by which it must be likelier.
    """
    paid = search.paid(after.hypothesis) - search.paid(before.hypothesis)
    nats = search.tempering.factor * left_out(search.predictor, before, after)
    return len(nats) > 1 and float(nats.min(initial=np.inf)) - paid > least


def left_out(predictor: Predictor, before: Fitted, after: Fitted) -> Array:
    """Return the gain in log-likelihood of all trials but one, for each one left out, (S,) [nats].

    Args:
        predictor: evaluates hypotheses on the data.
        before: a fit.
        after: another fit. The gain is zero if it uses other samples (a different sensor delay).
    """
    apart = folds(predictor.data)
    start = (_beside(before.hypothesis, after.hypothesis), after.noise, after.track)
    less = refine(predictor, [start], iterations=1, fixed_noise=True)
    if not less or abs(_constant(less[0]) - _constant(after)) > SAME_SAMPLES * abs(after.loglik):
        return np.zeros(len(np.unique(apart)))
    return _of_others(predictor, after, apart) - _of_others(predictor, less[0], apart)


def _beside(h: Hypothesis, other: Hypothesis) -> Hypothesis:
    """Return a hypothesis with the values of another for common effects, against single trials."""
    known = dict(zip(other.names, other.values, strict=True))
    values = tuple(known.get(n, v) for n, v in zip(h.names, h.values, strict=True))
    return replace(h, values=values, shift=other.shift if h.spread > 0 else h.shift)


def _of_others(predictor: Predictor, fit: Fitted, apart: Any) -> Array:
    """Return the log-likelihood of all trials but one, at their own values, up to a constant."""
    pull, prior, found = fit.prior_pull(predictor.data), np.diag(fit.prior), []
    for trial in np.unique(apart):
        rest = apart != trial
        s, G = fit.score[rest].sum(axis=0), fit.gram[rest].sum(axis=0)
        step = -np.linalg.pinv(G + prior, hermitian=True) @ (s + pull)
        rss = fit.rss[rest].sum() + 2 * s @ step + step @ G @ step
        found.append(-0.5 * float(rss + fit.logdet[rest].sum()))
    return np.array(found)


def _constant(fit: Fitted) -> float:
    """Return the part of the log-likelihood that depends only on which samples are counted."""
    return fit.loglik + 0.5 * float(fit.rss.sum() + fit.logdet.sum())
