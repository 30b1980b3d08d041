"""Whether several trials bear an effect out step by step: the finest ruler where noise is white.

A second ahead the noise of many steps has added up, and values of parameters that move beside an
effect are off by chance in all trials alike, which no scatter from trial to trial shows. Where
nothing but white noise is left, one step's prediction, weighed by the filter, is all that there is
to know. So each trial is left out in turn: do the others by themselves claim the effect? Both are
asked under the noise of the fit with the effect: without it noise grows for what a single trial
shows, and all the others would seem to gain.
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

SAME_SAMPLES = 1e-6  # of a likelihood: what a delayed sensor's first samples add is more


def borne_out(
    search: FittedHypotheses, before: Fitted, after: Fitted, least: float = CLAIM
) -> bool:
    """Whether trials would claim `after` rather than `before` without any one of them.

    least: by more than so many nats.
    """
    paid = search.paid(after.hypothesis) - search.paid(before.hypothesis)
    nats = search.tempering.factor * left_out(search.predictor, before, after)
    return len(nats) > 1 and float(nats.min(initial=np.inf)) - paid > least


def left_out(predictor: Predictor, before: Fitted, after: Fitted) -> Array:
    """By how much the other trials are likelier under `after`, each left out in turn, (S,) [nats].

    Args:
        predictor: the data.
        before: a fit.
        after: another one; nothing is gained where its samples are not the same.
    """
    apart = folds(predictor.data)
    start = (_beside(before.hypothesis, after.hypothesis), after.noise, after.track)
    less = refine(predictor, [start], iterations=1, fixed_noise=True)
    if not less or abs(_constant(less[0]) - _constant(after)) > SAME_SAMPLES * abs(after.loglik):
        return np.zeros(len(np.unique(apart)))
    return _of_others(predictor, after, apart) - _of_others(predictor, less[0], apart)


def _beside(h: Hypothesis, other: Hypothesis) -> Hypothesis:
    """A hypothesis with another's values, where that has them: one trial alone bends its own."""
    known = dict(zip(other.names, other.values, strict=True))
    values = tuple(known.get(n, v) for n, v in zip(h.names, h.values, strict=True))
    return replace(h, values=values, shift=other.shift if h.spread > 0 else h.shift)


def _of_others(predictor: Predictor, fit: Fitted, apart: Any) -> Array:
    """Log-likelihood of all trials but each, at their own values, but for a constant, (S,)."""
    pull, prior, found = fit.prior_pull(predictor.data), np.diag(fit.prior), []
    for trial in np.unique(apart):
        rest = apart != trial
        s, G = fit.score[rest].sum(axis=0), fit.gram[rest].sum(axis=0)
        step = -np.linalg.pinv(G + prior, hermitian=True) @ (s + pull)
        rss = fit.rss[rest].sum() + 2 * s @ step + step @ G @ step
        found.append(-0.5 * float(rss + fit.logdet[rest].sum()))
    return np.array(found)


def _constant(fit: Fitted) -> float:
    """What the samples that are counted add to a log-likelihood, whatever is predicted."""
    return fit.loglik + 0.5 * float(fit.rss.sum() + fit.logdet.sum())
