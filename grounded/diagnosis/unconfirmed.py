"""Effects that are likely but unconfirmed: too few trials show them to test them on held-out data.

The same holds for an effect that shows in one repeated motion only. They are
never claimed. Each is reported with the trial, the time and the region that show it, which is
where a further trial should go.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from grounded import places
from grounded.diagnosis.error_report import RulerRow
from grounded.diagnosis.hypotheses.explored import no_limits
from grounded.diagnosis.likelihood.levels import SURE
from grounded.diagnosis.parts import Unconfirmed
from grounded.diagnosis.validation.acting import acting
from grounded.diagnosis.validation.claims import Claims
from grounded.diagnosis.validation.decide import Doubtful
from grounded.diagnosis.validation.prediction_error import by_region
from grounded.effects import Effect, RateFamily
from grounded.frozen import Array

MENTIONED = 2
TRIFLE = 0.1  # of a prediction error: an effect that changes states by less shows in none


def unconfirmed(
    claims: Claims,
    doubtful: Sequence[Doubtful],
    groups: Sequence[Sequence[str]] = (),
    row: RulerRow | None = None,
) -> tuple[Unconfirmed, ...]:
    """Return the likeliest effects that were dropped and that few trials show, without ties.

    Args:
        claims: the causes that are claimed.
        doubtful: the likely effects that were dropped.
        groups: effects that the data cannot tell apart.
        row: prediction errors; effects that are trifles beside these are not returned.
    """
    if claims.known.no_cause:
        return ()
    tied = {name for group in groups for name in group}
    left = [one for one in doubtful if one.name not in tied]
    left = [one for one in left if one.name not in no_limits(claims.data, one.fit.hypothesis)]
    found = [_seen(claims, one) for one in left if row is None or not _trifling(claims, one, row)]
    return tuple([one for one in found if one is not None][:MENTIONED])


def _trifling(claims: Claims, one: Doubtful, row: RulerRow) -> bool:
    """Return whether an effect hardly changes any state beside the errors of predictions.

    Nobody needs to drive for a rate that is shown 0.05 % too large.
    """
    data, h, x = claims.data, one.fit.hypothesis, one.fit.track
    less = h.minus(one.name)
    both = [claims.predictor.next(each, x[:-1]) for each in (less, h)]
    moved = np.where(data.valid.T[..., None], data.model.difference(*both), 0.0)
    total = np.concatenate([np.zeros_like(moved[:1]), np.cumsum(moved, axis=0)])
    steps = min(max(1, round(row.horizon_s / data.dt)), len(moved))
    shown = np.zeros_like(x) + claims.predictor.offset(h, x) - claims.predictor.offset(less, x)
    size = np.abs(total[steps:] - total[:-steps]).max(axis=(0, 1), initial=0.0)
    size += np.abs(shown).max(axis=(0, 1), initial=0.0)
    errors = [row.with_effects.get(name, 0.0) for name in data.model.state_names]
    return bool((size <= TRIFLE * np.nan_to_num(errors)).all())


def _seen(claims: Claims, one: Doubtful) -> Unconfirmed | None:
    if not (few := one.one_group):
        return None
    data, acts = claims.data, acting(claims.predictor, one.fit, one.name)
    trial = int(np.bincount(data.trial_of, acts.sum(axis=0), data.count).argmax())
    own = np.flatnonzero(data.trial_of == trial)
    run = int(own[acts[:, own].sum(axis=0).argmax()])
    start, end = (t * data.dt for t in _stretch(acts[:, run] - acts.mean()))
    i = one.fit.hypothesis.names.index(one.name)
    anywhere = _anywhere(one.fit.hypothesis.effects[i])
    regions = by_region(acts, claims.predictor, one.fit, 1, but=anywhere)
    by = np.bincount(data.trial_of, acts.sum(axis=0), data.count)
    params, begin = claims.estimates(one.fit)[i], data.time[0, run]
    if not any(abs(e.value) > SURE * e.std for e in params.values()):
        return None  # its size is unknown
    return Unconfirmed(
        one.name,
        params,
        one.nats,
        data.ids[trial] or str(trial + 1),
        float(begin + start),
        float(begin + end),
        (few, data.count),
        regions[0] if regions else None,
        few > 1,
        tuple(data.ids[k] or str(k + 1) for k in np.argsort(-by)[:few]),
    )


def _anywhere(effect: Effect) -> Sequence[str]:
    """Return the coordinates on the ground if an effect acts alike at all places.

    A motor's delay showed "where y < -3.95 m": only the drive by hand went there.
    """
    where = places.position(effect.site.model)
    return () if len(where) < 2 or isinstance(effect.family, RateFamily) else where


def _stretch(more: Array) -> Any:
    """Return the interval of steps with the largest sum (Kadane's algorithm)."""
    total = np.concatenate([[0.0], np.cumsum(more)])
    least = np.minimum.accumulate(total)
    end = int((total - least).argmax())
    return int(total[: end + 1].argmin()), end
