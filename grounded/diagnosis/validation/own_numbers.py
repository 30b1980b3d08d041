"""The model's own numbers in place of effects, where these tie and predict as well.

And a cause that has a mechanism in place of a coupling, which has none.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

from grounded.diagnosis.hypotheses.explored import TIE
from grounded.diagnosis.hypotheses.lookalike import one_thing
from grounded.diagnosis.hypotheses.search import TO_THE_TOP, HypothesisSearch
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.validation.gain import BETTER
from grounded.diagnosis.validation.ruler import Ruler
from grounded.effects import Effect, ParamFamily

COUPLING = "coupling"
SURE = 8.0  # nats (odds of 3,000 to 1) above which an effect counts as certain by evidence


def own_numbers(search: HypothesisSearch, fit: Fitted, ruler: Ruler) -> Fitted:
    """Replace effects by shifts of the model's parameters, if these tie and predict as well.

    A parameter declared uncertain, or an adopted delay, is more probably off than an equation
    missing. One that is the effect itself, in any trial (`one_thing`), ties if it explains as much,
    however far off it is: a drag that an earlier diagnosis had left at its bound, a third of its
    value, became a state that "changes 216 % faster than modelled".
    """
    h, score = fit.hypothesis, search.score
    params = {e.name for e in search.candidates if e.known or isinstance(e.family, ParamFamily)}
    own = {e.name: (e, v) for e, v in h.pairs}
    for name in [n for n in equations(fit) if n not in params] if h.spread == 0 else ():
        rest = {*h.names} - {name}
        sets = {tuple(sorted({*rest, param})) for param in params - rest}

        same = _same(search, own[name][0])

        def lacks(other: Fitted, name: str = name, same: Mapping[str, Effect] = same) -> float:
            """Return the nats that another fit lacks; the price of what is the same counts not."""
            nats = score(fit) - score(other)
            for effect, values in other.hypothesis.pairs:
                if effect.name in same and effect.name not in own:
                    nats += search.price(*own[name]) - search.price(effect, values)
            return nats

        def likeliest(sets: set[tuple[str, ...]] = sets) -> Fitted:
            exact = [f for (_, w, names), f in search.fits.items() if names in sets and not w]
            return min(exact, key=lacks, default=fit)

        for param in same.values():  # fits beside other effects may not have found its size
            if param.name not in rest:
                begun = {q.name: q.start for q in param.free}
                start = (h.minus(name).plus(param, begun), fit.noise, fit.track)
                search.refined([start], TO_THE_TOP)
        if lacks(likeliest()) < 2 * TIE:
            search.finished([likeliest()], TO_THE_TOP)
        other = likeliest()
        ties = other is not fit and lacks(other) < TIE
        if ties and not ruler.gain(other, fit).beyond(*BETTER):
            return own_numbers(search, other, ruler)
    return _calibrated_instead(search, fit, ruler)


def _same(search: HypothesisSearch, effect: Effect) -> dict[str, Effect]:
    """Return the errors of parameters that are the same as an effect in any trial, by name."""
    names = search.data.model.param_names
    return {
        param.name: param
        for param in search.candidates
        if isinstance(param.family, ParamFamily)
        and one_thing(search.predictor, names.index(param.site.target), effect)
    }


def with_mechanism(search: HypothesisSearch, fit: Fitted) -> Fitted | None:
    """Return the likeliest fit with a mechanism in place of a coupling that is not far likelier.

    A state may act on any rate, so there are many couplings, and they imitate other causes: a
    position that is measured d late is, to first order, a coupling of -d times the model's own
    slope. A ball's camera, 30 ms late, was such a coupling, by 5 nats.
    """
    h, found = fit.hypothesis, []
    for effect in h.effects:
        if effect.family.name == COUPLING:
            rest = {*h.names} - {effect.name}
            found += [
                f
                for f in search.fits.values()
                if len(f.hypothesis.names) == len(h.names) and rest <= {*f.hypothesis.names}
                if f.hypothesis.spread == h.spread and search.score(fit) - search.score(f) < SURE
                if not any(e.family.loose for e in f.hypothesis.effects if e.name not in rest)
            ]
    return max(found, key=search.score, default=None)


def _calibrated_instead(search: HypothesisSearch, fit: Fitted, ruler: Ruler) -> Fitted:
    """Replace further effects by calibration of all parameters, unless they are much likelier.

    If all parameters are slightly off, no single shift equals an effect with two values, but all
    shifts together do. So each effect beside another cause must be worth SURE nats.
    """
    h, score, names = fit.hypothesis, search.score, equations(fit)
    if h.spread > 0 or len(h.names) < 2:
        return fit
    rests = {
        tuple(sorted({*h.names} - {*some})): SURE * count
        for count in range(1, min(len(names), len(h.names) - 1) + 1)
        for some in combinations(names, count)
    }

    def lacks(other: Fitted) -> float:
        """Return the nats that another fit lacks to replace this one; below zero, it does."""
        return score(fit) - score(other) - rests[tuple(sorted(other.hypothesis.names))]

    def nearest() -> Fitted:
        free = [f for (_, w, some), f in search.fits.items() if w and some in rests]
        return min(free, key=lacks, default=fit)

    if (other := nearest()) is not fit and lacks(other) < SURE:
        search.finished([other], TO_THE_TOP)
        other = nearest()
    as_good = other is not fit and lacks(other) < 0
    return fit if not as_good or ruler.gain(other, fit).beyond(*BETTER) else other


def equations(fit: Fitted) -> list[str]:
    """Return the names of the effects that are not parameters."""
    return [e.name for e in fit.hypothesis.effects if not isinstance(e.family, ParamFamily)]
