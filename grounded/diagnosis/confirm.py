"""No claim whose predictions of held-out trials run away: evidence alone does not see that.

Values that one trial alone determines (a wave, a saturation that one run reaches) can make the
other trials' predictions useless. Such a hypothesis gives way to the next one that holds.
"""

from __future__ import annotations

from grounded.diagnosis.fitted import Fit
from grounded.diagnosis.gap import horizon
from grounded.diagnosis.search import CLAIM, Search
from grounded.diagnosis.shrinkage import shrinkage

RUNAWAY = 3.0  # times the gap without the effects: beyond what sensors that differ may cost
TRIES = 6  # hypotheses that are looked at


def confirmed(search: Search, best: Fit, seconds: float) -> Fit:
    """The best hypothesis, or the likeliest one below it that predicts held-out trials.

    Args:
        search: with all hypotheses that were fitted.
        best: the one that would be claimed.
        seconds: how far ahead trials are predicted [s].
    """
    null, score = search.best_null(), search.score
    if not best.hypothesis.effects or search.data.count < 2:
        return best
    size = len(best.hypothesis.effects)
    rivals = [f for k in range(1, size + 1) for f in search.of_size(k) if f is not best]
    rivals = [f for f in rivals if score(null) + CLAIM < score(f) <= score(best)]
    rivals.sort(key=lambda f: -score(f))
    for fit in [best, *rivals[: TRIES - 1]]:
        where = horizon(search.predictor, fit, seconds)
        found = shrinkage(search.predictor, fit, null.track, where)
        if not found.gap_after > RUNAWAY * found.gap_before:
            return fit
    return null
