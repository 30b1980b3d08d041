"""Which of the model's own parameters are off.

If calibrating the model's own parameters explains the gap, the parameters that are off are named by
forward selection. The log posterior of the shifts is approximated by a parabola at the calibrated
fit, with curvature H. If only a set S of the parameters may differ from nominal, its maximum is
lower by

    loss(S) = 1/2 b' (H_rr - H_rS H_SS^-1 H_Sr) b,        r: the others, b: their shifts

Parameters are added to S one by one, each time the one that lowers the loss most, until the loss is
below NATS. So if the data only determine a combination of two parameters (a gain and a time
constant), not both are blamed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.levels import NATS, SHARE, SURE
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.fitted import Fitted, calibrated, moved
from grounded.diagnosis.likelihood.hypothesis import param_scale
from grounded.diagnosis.validation.ruler import Ruler
from grounded.frozen import Array


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
    b = h.shift[which] / param_scale(data.model)[which]
    free, now = fewest(H, b, range(len(b)))
    held = still(H, b, free)  # at nominal; the others do their work
    while held:
        fewer, then = fewest(H, b, [i for i in range(len(b)) if i not in held])
        if then <= NATS:
            free, now = fewer, then
            break
        held = held[1:]
    nats = {i: loss(H, b, [j for j in free if j != i]) - now for i in free}
    if ruler.held_out:
        least = SHARE * ruler.since_outset(fit)
        rest = fit
        for i in held:
            rest = unmoved(data, rest, k + i)
        gains = {i: ruler.gain(unmoved(data, rest, k + i), fit).mean for i in free}
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


def still(H: Array, b: Array, free: Sequence[int]) -> list[int]:
    """Return the selected shifts that may be none, the smallest last, if another one clearly is."""
    sizes = np.abs(b) / np.sqrt(np.diag(np.linalg.pinv(H, hermitian=True)) + 1e-300)
    none = [i for i in sorted(free, key=lambda i: -sizes[i]) if sizes[i] < SURE]
    return none if sizes.max(initial=0.0) > SURE else []


def unmoved(data: Data, fit: Fitted, column: int) -> Fitted:
    """Return the fit with one parameter at nominal, the others fitted again by a Newton step."""
    h, index = fit.hypothesis, calibrated(data)[column - len(fit.hypothesis.theta)]
    assert h.shift is not None
    shift = h.shift[index] / param_scale(data.model)[index]
    H = fit.gram.sum(axis=0) + np.diag(fit.prior)
    rest = np.delete(np.arange(len(H)), column)
    delta = np.zeros(len(H))
    delta[column] = -shift
    delta[rest] = shift * np.linalg.pinv(H[np.ix_(rest, rest)], hermitian=True) @ H[rest, column]
    gram, score = fit.gram.copy(), fit.score - fit.gram @ delta
    gram[:, column], gram[..., column], score[:, column] = 0.0, 0.0, 0.0  # it is fixed there
    return replace(fit, hypothesis=moved(data, fit.hypothesis, delta), gram=gram, score=score)
