"""What the bounds of the model's parameters say about an effect beside them.

A bound excludes values by the user's word. If parameters reach it only without an effect, the
effect is needed (`held_up`). If they reach it only beside the effect, and the two values go
together, the bound decides how large the effect is, not the data, and it is not claimed
(`set_by_bound`).
"""

from __future__ import annotations

import numpy as np

from grounded.diagnosis.hypotheses.search import LARGE_GAIN, HypothesisSearch
from grounded.diagnosis.likelihood.fitted import Fitted, calibrated
from grounded.diagnosis.validation.own_numbers import equations

TOGETHER = 0.9  # correlation from which a parameter's bound decides how large an effect is


def held_up(search: HypothesisSearch, fit: Fitted, less: Fitted, name: str) -> tuple[str, ...]:
    """Return the model's parameters that a likely effect keeps off their bounds.

    Without it, they describe the data only with values that the user excludes. None if as many are
    at their bounds with it.
    """
    if name not in equations(fit) or not search.score(fit) - search.score(less) > LARGE_GAIN:
        return ()
    with_it, without = stopped(search, fit), stopped(search, less)
    if len(without) <= len(with_it):
        return ()
    return tuple(one for one in without if one not in with_it)


def set_by_bound(search: HypothesisSearch, fit: Fitted, less: Fitted, name: str) -> bool:
    """Check whether a bound of the model's parameters decides how large an effect is.

    Beside the effect a parameter ends at its bound, without it (`less`) none does that did not, and
    the two values go together: with a wider bound the effect would be larger. A boat's model had a
    cross term that the boat lacks; a speed that changes 70 % slower made that term smaller, and
    four times the thrust, up to its bound, left the other terms as they were.
    """
    with_it, without = {*stopped(search, fit)}, {*stopped(search, less)}
    if not without < with_it:
        return False
    return any(abs(r) > TOGETHER for r in _correlations(search, fit, name, with_it - without))


def stopped(search: HypothesisSearch, fit: Fitted) -> list[str]:
    """Return the model's parameters that a fit leaves at a bound."""
    model, shift = search.data.model, fit.hypothesis.shift
    values = model.values if shift is None else model.values + shift
    params = zip(model.params.items(), values, strict=True)
    return [name for (name, param), value in params if param.stopped(float(value))]


def _correlations(
    search: HypothesisSearch, fit: Fitted, name: str, params: set[str]
) -> list[float]:
    """Return the correlations of an effect's values with the shifts of parameters."""
    names, h, C = list(search.data.model.params), fit.hypothesis, fit.covariance
    owners = [effect.name for effect in h.effects for _ in effect.free]
    owners += [names[i] for i in calibrated(search.data)] if len(C) > len(owners) else []
    k = len(h.theta)
    own = [i for i in range(k) if owners[i] == name]
    at_bound = [j for j in range(k, len(C)) if owners[j] in params]
    d = np.sqrt(np.maximum(np.diag(C), 1e-300))
    return [float(C[i, j] / d[i] / d[j]) for i in own for j in at_bound]
