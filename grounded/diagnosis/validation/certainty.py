"""How certain the claim's values are, beyond what one fit says of itself (`intervals`).

**Averaged**: the claim's own interval assumes its noise structure, and exact parameters if they
were not calibrated. Yet the parameters may be off, if evidence hardly separates the fits or
calibration was dropped because predictions don't need it. So the variance is averaged, by evidence,
over all fits of the same effects: other noise structures, parameters held or free (Hoeting,
Madigan, Raftery & Volinsky, Bayesian model averaging, 1999),

    var = sum_f p_f (var_f + (value_f - value)^2)

about the claim's own value. Fits that predict held-out trials clearly worse are left out.

**Blamed**: the model's own parameters that are off, by forward selection. The log posterior of the
shifts is approximated by a parabola at the calibrated fit, with curvature H. If only a set S of
them may differ from nominal, its maximum is lower by

    loss(S) = 1/2 b' (H_rr - H_rS H_SS^-1 H_Sr) b,        r: the others, b: their shifts

Parameters are added to S one by one, each time the one that lowers the loss most, until the loss is
below NATS. So if the data only determine a combination of two parameters (a gain and a time
constant), not both are blamed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.diagnosis.hypotheses.explored import FittedHypotheses
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.levels import NATS, PICKED, SHARE
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.fitted import Fitted, calibrated, moved
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.intervals import NORMAL
from grounded.diagnosis.validation.ruler import Ruler
from grounded.frozen import Array

LIKELIER_AT_MOST = 50.0  # most nats by which another fit counts as likelier


def averaged(search: FittedHypotheses, fit: Fitted, ruler: Ruler) -> tuple[Array, Array]:
    """Return averaged standard deviations and half-widths of 95 % intervals, (C,) each.

    Args:
        search: holds all fits of the same effects.
        fit: the claim.
        ruler: excludes fits that predict clearly worse.
    """
    std, half = (np.array(a) for a in search.sure(fit))
    own, size = _values(fit.hypothesis), len(fit.hypothesis.theta)
    var, wide, whole = std[:size] ** 2, half[:size] ** 2, 1.0
    for other, weight in _rivals(search, fit, ruler):
        theirs = _values(other.hypothesis)
        rows = [theirs[key] for key in own]
        apart = other.hypothesis.theta[rows] - fit.hypothesis.theta
        s, h = (a[rows] for a in search.sure(other))
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
            found += [] if worse else [(other, math.exp(min(nats, LIKELIER_AT_MOST)))]
    return found


def _values(h: Hypothesis) -> dict[tuple[str, str], int]:
    """Return {(effect, quantity): index} of the free values."""
    return {key: i for i, key in enumerate((e.name, q.name) for e in h.effects for q in e.free)}


@dataclass(frozen=True)
class Blame:
    """A parameter that is off: its index in the model, and the loss at its nominal value [nats]."""

    index: int
    nats: float


def loss(H: Array, b: Array, free: list[int]) -> float:
    """Return the loss of log posterior if only `free` shifts may differ from zero [nats]."""
    rest = [i for i in range(len(b)) if i not in free]
    if not rest:
        return 0.0
    block, left = H[np.ix_(rest, rest)], b[rest]
    if free:
        across = H[np.ix_(rest, free)]
        block = block - across @ np.linalg.pinv(H[np.ix_(free, free)], hermitian=True) @ across.T
    return 0.5 * float(left @ block @ left)


def moved_parameters(search: HypothesisSearch, fit: Fitted, ruler: Ruler) -> tuple[Blame, ...]:
    """Return the parameters of a calibrated fit that must differ from nominal, by importance.

    Evidence selects as few as possible, so that the others gain less than NATS. Of these, one
    after another is left out, the least needed first, if predictions with it at nominal, the others
    fitted again, are as good. So of two that can do each other's work, one stays.
    """
    data, h = search.data, fit.hypothesis
    if h.spread == 0 or h.shift is None:
        return ()
    k, which = len(h.theta), calibrated(data)
    G = fit.gram.sum(axis=0)
    across = G[k:, :k]
    H = G[k:, k:] - across @ np.linalg.pinv(G[:k, :k], hermitian=True) @ across.T
    H = H + np.diag(fit.prior[k:])
    b = h.shift[which] / data.model.spreads[which]
    free, now = fewest(H, b, range(len(b)))
    nats = {i: loss(H, b, [j for j in free if j != i]) - now for i in free}
    if ruler.held_out:
        least = SHARE * ruler.since_outset(fit)
        rest = fit
        gains = {i: ruler.gain(unmoved(data, fit, k + i), fit).mean for i in free}
        for i in sorted(free, key=lambda i: gains[i])[:-1]:
            less = unmoved(data, rest, k + i)  # beside those left out already, which may hide it
            if gains[i] < least and ruler.gain(less, fit).mean < least:
                free, rest = [j for j in free if j != i], less
    # the parabola can't gain more than the fit itself
    whole = max(search.score(fit) - search.score(search.exact_null()), 0.0)
    worth = {i: min(search.tempering.factor * nats[i], whole) for i in free}
    return tuple(Blame(int(which[i]), worth[i]) for i in sorted(free, key=lambda i: -nats[i]))


def fewest(H: Array, b: Array, allowed: Sequence[int]) -> tuple[list[int], float]:
    """Select as few of the allowed shifts as possible; return them and what the others lose."""
    free: list[int] = []
    now = loss(H, b, free)
    while len(free) < len(allowed) and (now > NATS or not free):
        losses = {i: loss(H, b, [*free, i]) for i in allowed if i not in free}
        i = min(losses, key=lambda j: losses[j])
        free, now = [*free, i], losses[i]
    return free, now


def unmoved(data: Data, fit: Fitted, column: int) -> Fitted:
    """Return the fit with one parameter at nominal, the others fitted again by a Newton step."""
    h, index = fit.hypothesis, calibrated(data)[column - len(fit.hypothesis.theta)]
    assert h.shift is not None
    shift = h.shift[index] / data.model.spreads[index]
    H = fit.gram.sum(axis=0) + np.diag(fit.prior)
    rest = np.delete(np.arange(len(H)), column)
    delta = np.zeros(len(H))
    delta[column] = -shift
    delta[rest] = shift * np.linalg.pinv(H[np.ix_(rest, rest)], hermitian=True) @ H[rest, column]
    gram, score = fit.gram.copy(), fit.score - fit.gram @ delta
    gram[:, column], gram[..., column], score[:, column] = 0.0, 0.0, 0.0  # it is fixed there
    return replace(fit, hypothesis=moved(data, fit.hypothesis, delta), gram=gram, score=score)
