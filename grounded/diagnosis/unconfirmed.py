"""What was seen once: likely effects of too few trials for predictions of others to bear them out.

They are never causes. Each is told with the trial, the time and the region that show it, where a
further trial would have to go. What most trials show as likely, and none predicts better by, is a
fault of the likelihood and is not told.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from grounded.diagnosis.report import Unconfirmed
from grounded.diagnosis.validation.claims import Claims
from grounded.diagnosis.validation.decide import Doubtful
from grounded.diagnosis.validation.prediction_error import by_region
from grounded.diagnosis.verdict import meaning
from grounded.frozen import Array

MENTIONED = 2
MOST = 0.8  # of the evidence, which few trials hold
FEW = 4  # one of so many trials


def unconfirmed(claims: Claims, doubtful: Sequence[Doubtful]) -> tuple[Unconfirmed, ...]:
    """The likeliest effects that a decision dropped, of those that few trials show."""
    if claims.known.no_cause:
        return ()
    found = [_seen(claims, one) for one in doubtful]
    return tuple([one for one in found if one is not None][:MENTIONED])


def _seen(claims: Claims, one: Doubtful) -> Unconfirmed | None:
    data, nats = claims.data, _by_step(claims, one)
    by = np.maximum(np.bincount(data.trial_of, nats.sum(axis=0), data.count), 0.0)
    held = np.cumsum(np.sort(by)[::-1])
    few = 1 + int(np.searchsorted(held, MOST * held[-1]))
    if data.count < 2 or few > max(data.count // FEW, 1):
        return None
    trial = int(by.argmax())
    own = np.flatnonzero(data.trial_of == trial)
    run = int(own[nats[:, own].sum(axis=0).argmax()])
    start, end = (t * data.dt for t in _stretch(nats[:, run]))
    regions = by_region(np.maximum(nats, 0.0)[..., None], claims.predictor, one.fit, 1)
    i = one.fit.hypothesis.names.index(one.name)
    params, begin = claims.estimates(one.fit)[i], data.time[0, run]
    return Unconfirmed(
        one.name,
        meaning(one.fit.hypothesis.effects[i], params),
        params,
        one.nats,
        data.ids[trial] or str(trial + 1),
        float(begin + start),
        float(begin + end),
        (few, data.count),
        regions[0] if regions else None,
    )


def _by_step(claims: Claims, one: Doubtful) -> Array:
    """What each step says for it, (L, B) [nats]."""
    valid = claims.data.valid.T
    square = (one.less.white**2 - one.fit.white**2).sum(axis=-1)
    spread = (one.less.logdet - one.fit.logdet) / np.maximum(valid.sum(axis=0), 1)
    return np.asarray(0.5 * (square + spread) * valid)


def _stretch(nats: Array) -> Any:
    """From which step to which most is said (Kadane's largest sum of neighbours)."""
    total = np.concatenate([[0.0], np.cumsum(nats)])
    least = np.minimum.accumulate(total)
    end = int((total - least).argmax())
    return int(total[: end + 1].argmin()), end
