"""No claim that held-out trials contradict: evidence alone does not see that.

Four ways in which the likeliest hypothesis can be wrong, most of them where predictions miss by far
more than noise makes: something is wrong then that is not in the library, and likelihoods are those
of a wrong model.

Noise that is allowed to be coloured, or parameters that are allowed to move, explain a lasting
effect away that predictions a second ahead still miss (a bias of a motor, a friction that is lower
at first): another noise is confirmed. A further effect takes up what is left somewhere and predicts
hardly better: it is dropped. So is what makes less than a two-hundredth of the gap: where there is
next to no noise, the last digits of a step can be a claim. And values that one trial alone
determines (a wave, a saturation that one run reaches) make predictions of the others worse: another
hypothesis takes its place.
"""

from __future__ import annotations

from grounded.diagnosis.fitted import Fit
from grounded.diagnosis.hypotheses import CLAIM
from grounded.diagnosis.prediction_error import Horizon, horizon
from grounded.diagnosis.search import Search
from grounded.diagnosis.shrinkage import Shrinkage, gaps_of, shrinkage

MISFIT = 1.3  # times what noise makes of predictions, from which the noise is doubted
BETTER = 1.5  # times smaller is what another noise has to leave
WORTH = 1.3  # times larger is the gap without an effect that is worth naming in a misfit
SLIGHT = 0.005  # of the bare model's gap: what is not worth a name
WORSE = 1.1  # times the gap without the effects
TRIES = 6  # hypotheses that are looked at


def noise_confirmed(search: Search, best: Fit, most: int, seconds: float) -> tuple[Search, Fit]:
    """The search and its best hypothesis, under the noise whose claims predict held-out trials.

    Another structure of noise, or exact parameters, is preferred to the likeliest one only where
    that one's claim leaves much more than noise and the other's leaves much less.

    Args:
        search: with all hypotheses that were fitted.
        best: the likeliest one.
        most: so many effects at most.
        seconds: how far ahead trials are predicted [s].
    """
    if not best.hypothesis.effects or search.data.count < 2:
        return search, best
    where = horizon(search.predictor, best, seconds)
    (gap,) = gaps_of(search.predictor, [best], where)
    if not gap > MISFIT:
        return search, best
    found = []
    for structure, spread in dict.fromkeys((s, w) for s, w, _ in search.fits):
        if (structure, spread) == (best.noise.structure, best.hypothesis.spread):
            continue
        other = search.under(structure, spread)
        if other is not None and (rival := other.chosen(most)).hypothesis.effects:
            found.append((gaps_of(search.predictor, [rival], where)[0], other, rival))
    found = [each for each in found if each[0] * BETTER < gap]
    if not found:
        return search, best
    _, other, rival = min(found, key=lambda each: each[0])
    other.finished(other.of_size(len(rival.hypothesis.effects))[:TRIES], 20)
    return other, other.chosen(most)


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
        if not found.gap_after > WORSE * found.gap_before:
            return _pruned(search, fit, found, where)
    return null


def _pruned(search: Search, fit: Fit, held: Shrinkage, where: Horizon) -> Fit:
    """Without the effects that hardly matter: in a misfit, or beside one that makes all the gap."""
    gap, slight = held.gap_after, SLIGHT * held.gap_before
    while fit.hypothesis.effects and (gap > MISFIT or slight > max(gap, 1.0)):
        names = set(fit.hypothesis.names)
        fewer = [f for f in search.of_size(len(names) - 1) if set(f.hypothesis.names) < names]
        fewer = fewer if len(names) > 1 else [search.best_null()]
        gaps = gaps_of(search.predictor, fewer, where)
        if not gaps or not min(gaps) < max(WORTH * gap if gap > MISFIT else 0.0, slight):
            break
        gap, fit = min(zip(gaps, fewer, strict=True), key=lambda each: each[0])
    return fit
