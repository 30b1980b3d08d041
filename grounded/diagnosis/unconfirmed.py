"""What was seen once: likely effects that held-out predictions of other trials don't bear out.

They are never causes. Each is told with the trial, the time and the region that show it most, where
a further trial would have to go.
"""

from __future__ import annotations

import numpy as np

from grounded.diagnosis.report import Unconfirmed
from grounded.diagnosis.validation.claims import Claims
from grounded.diagnosis.validation.decide import Doubtful
from grounded.diagnosis.validation.prediction_error import by_region
from grounded.diagnosis.validation.ruler import Ruler
from grounded.diagnosis.verdict import meaning

MENTIONED = 2


def unconfirmed(claims: Claims, doubtful: tuple[Doubtful, ...], ruler: Ruler) -> list[Unconfirmed]:
    """The likeliest effects of a decision that predictions did not bear out."""
    if claims.known.no_cause:
        return []
    return [_seen(claims, one, ruler) for one in doubtful[:MENTIONED]]


def _seen(claims: Claims, one: Doubtful, ruler: Ruler) -> Unconfirmed:
    data, gain = claims.data, np.maximum(one.gain.pieces, 0.0)
    best, ahead = int(gain.argmax()), ruler.steps[-1]
    run, trial = int(ruler.run_of[best]), int(one.gain.trial[best])
    begin = int(data.step_at[run, 0] - ruler.step0[trial])
    first = begin + (best - int(ruler.piece0[run])) * ahead
    last = min(first + 2 * ahead, int(data.lengths[trial]))  # predicted from one, in the next
    there = np.zeros((*data.valid.T.shape, 1))
    there[first - begin : last - begin, run] = 1.0
    regions = by_region(there * data.valid.T[..., None], claims.predictor, one.fit, 1)
    i = one.fit.hypothesis.names.index(one.name)
    params = claims.estimates(one.fit)[i]
    return Unconfirmed(
        one.name,
        meaning(one.fit.hypothesis.effects[i], params),
        params,
        one.nats,
        data.ids[trial] or str(trial + 1),
        first * data.dt,
        last * data.dt,
        float(gain[one.gain.trial == trial].sum() / max(gain.sum(), 1e-300)),
        regions[0] if regions else None,
    )
