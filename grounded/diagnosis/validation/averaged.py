"""Bayesian model averaging of a claim's standard deviations and intervals.

The claim's own interval assumes its noise structure, and exact parameters if they were not
calibrated. Yet the parameters may be off, if evidence hardly separates the fits or calibration was
dropped because predictions don't need it. So the variance is averaged, by evidence, over all fits
of the same effects: other noise structures, parameters held or free (Hoeting, Madigan, Raftery &
Volinsky, Bayesian model averaging, 1999),

    var = sum_f p_f (var_f + (value_f - value)^2)

about the claim's own value. Fits that predict held-out trials clearly worse are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from grounded.diagnosis.hypotheses.explored import FittedHypotheses
from grounded.diagnosis.levels import PICKED
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.intervals import NORMAL
from grounded.diagnosis.validation.ruler import Ruler
from grounded.frozen import Array

MOST = 50.0  # most nats by which another fit counts as likelier

Sure = tuple[Array, Array]


def averaged(
    search: FittedHypotheses, fit: Fitted, ruler: Ruler, of: Callable[[Fitted], Sure]
) -> Sure:
    """Return averaged standard deviations and half-widths of 95 % intervals, (C,) each.

    Args:
        search: holds all fits of the same effects.
        fit: the claim.
        ruler: excludes fits that predict clearly worse.
        of: returns both for a single fit.
    """
    std, half = (np.array(a) for a in of(fit))
    own, size = _values(fit.hypothesis), len(fit.hypothesis.theta)
    var, wide, whole = std[:size] ** 2, half[:size] ** 2, 1.0
    for other, weight in _rivals(search, fit, ruler):
        theirs = _values(other.hypothesis)
        rows = [theirs[key] for key in own]
        apart = other.hypothesis.theta[rows] - fit.hypothesis.theta
        s, h = (a[rows] for a in of(other))
        var, wide = var + weight * (s**2 + apart**2), wide + weight * (h**2 + (NORMAL * apart) ** 2)
        whole += weight
    std[:size] = np.maximum(std[:size], np.sqrt(var / whole))
    half[:size] = np.maximum(half[:size], np.sqrt(wide / whole))
    return std, half


def _rivals(search: FittedHypotheses, fit: Fitted, ruler: Ruler) -> list[tuple[Fitted, float]]:
    """Return other fits of the same free values, and the weight of each relative to the claim."""
    names, own, found = sorted(fit.hypothesis.names), _values(fit.hypothesis), []
    for (_, _, some), other in search.fits.items():
        nats = search.score(other) - search.score(fit)
        likely = other is not fit and list(some) == names and nats > -PICKED
        if likely and set(_values(other.hypothesis)) == set(own):
            worse = ruler.held_out and ruler.gain(other, fit).clear
            found += [] if worse else [(other, math.exp(min(nats, MOST)))]
    return found


def _values(h: Hypothesis) -> dict[tuple[str, str], int]:
    """Return {(effect, quantity): index} of the free values."""
    return {key: i for i, key in enumerate((e.name, q.name) for e in h.effects for q in e.free)}
