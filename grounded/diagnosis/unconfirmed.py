"""Effects that are likely but unconfirmed: too few trials show them to test them on held-out data.

The same holds for an effect that shows in one repeated motion only. They are
never claimed. Each is reported with the trial, the time and the region that show it, which is
where a further trial should go.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grounded import places
from grounded.diagnosis.hypotheses.explored import no_limits
from grounded.diagnosis.levels import SURE
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.parts import Unconfirmed
from grounded.diagnosis.validation.claims import Claims
from grounded.diagnosis.validation.decide import Doubtful
from grounded.diagnosis.validation.prediction_error import by_region
from grounded.effects import Effect, RateFamily
from grounded.frozen import Array

MENTIONED = 2
MEMORY = 1e-2  # fraction of a memory state's spread that stands in for its noise, which is zero


def unconfirmed(
    claims: Claims,
    doubtful: Sequence[Doubtful],
    groups: Sequence[Sequence[str]] = (),
) -> tuple[Unconfirmed, ...]:
    """Return the likeliest effects that were dropped and that few trials show, without ties.

    Args:
        claims: the causes that are claimed.
        doubtful: the likely effects that were dropped.
        groups: effects that the data cannot tell apart.
    """
    if claims.known.no_cause:
        return ()
    tied = {name for group in groups for name in group}
    left = [one for one in doubtful if one.name not in tied]
    left = [one for one in left if one.name not in no_limits(claims.data, one.fit.hypothesis)]
    found = [_seen(claims, one) for one in left]
    return tuple([one for one in found if one is not None][:MENTIONED])


def _seen(claims: Claims, one: Doubtful) -> Unconfirmed | None:
    if not (few := one.one_group):
        return None
    data, acts = claims.data, acting(claims.predictor, one.fit, one.name)
    by = np.bincount(data.trial_of, acts.sum(axis=0), data.count)
    names = tuple(data.ids[k] or str(k + 1) for k in np.argsort(-by)[:few])
    i = one.fit.hypothesis.names.index(one.name)
    anywhere = _anywhere(one.fit.hypothesis.effects[i])
    regions = by_region(acts, claims.predictor, one.fit, 1, but=anywhere)
    params = claims.estimates(one.fit)[i]
    if not any(abs(e.value) > SURE * e.std for e in params.values()):
        return None  # its size is unknown
    return Unconfirmed(
        one.name,
        params,
        one.nats,
        names[0],
        (few, data.count),
        regions[0] if regions else None,
        few > 1,
        names,
    )


def _anywhere(effect: Effect) -> Sequence[str]:
    """Return the coordinates on the ground if an effect acts alike at all places.

    A motor's delay showed "where y < -3.95 m": only the drive by hand went there.
    """
    where = places.position(effect.site.model)
    return () if len(where) < 2 or isinstance(effect.family, RateFamily) else where


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
