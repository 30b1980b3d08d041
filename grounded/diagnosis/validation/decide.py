"""Model selection: evidence proposes hypotheses, held-out predictions decide which is claimed.

The likeliest hypothesis can be wrong in ways that its evidence does not show. Coloured noise or
free parameters can absorb a persistent effect that predictions a second ahead still miss. A further
effect can fit the residual somewhere without better predictions. Values determined by one trial can
make predictions of the others worse. Far above the noise floor, likelihoods are those of a wrong
model, and even thousands of nats are not conclusive. So the likeliest hypotheses, and the likeliest
under every other noise structure, are compared by the `ruler`:

    1. A rival replaces the likeliest hypothesis only if it predicts clearly better.
    2. A cause is dropped if predictions without it are as good within their scatter, or to half a
       per cent of their errors in the mean (other trials gain nothing by it). A further
       effect with very high evidence, beside white innovations only, is dropped only if predictions
       gain nothing. What would leave a gap stays, and a late sensor that its own channel shows.
    3. An effect that a parameter's shift undoes is dropped; the parameter alone describes both. So
       is one whose size is set by a parameter's bound.
       A likely effect stays without which the model's parameters would end at their bounds, if
       predictions gain by it at all.
    4. An effect without a mechanism that a single motion shows is dropped, however often the motion
       was repeated, unless its one coefficient explains all that the model lacks and nothing else
       explains nearly as much.
    5. The remaining effects must be likelier than none.
    6. A hypothesis is not claimed if predictions hardly gain in any channel at any horizon, except
       sensors' faults with very high evidence, which need not matter for what comes next, and
       likely causes beside white innovations whose small gain is far beyond its scatter, or
       without which a gap is left.
    7. A likely effect that was dropped is reported as doubtful; perhaps too few trials show it.

A cause is an effect or the calibration of the model's own parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from grounded.diagnosis.error_report import CALIBRATION
from grounded.diagnosis.hypotheses.counterpart import counterparts
from grounded.diagnosis.hypotheses.explored import CLAIM, TIE, parametric
from grounded.diagnosis.hypotheses.joint_model import split
from grounded.diagnosis.hypotheses.leftover import corrections, leftovers
from grounded.diagnosis.hypotheses.plainest import plainer
from grounded.diagnosis.hypotheses.search import LARGE_GAIN, TO_THE_TOP, HypothesisSearch
from grounded.diagnosis.hypotheses.swaps import parted
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.noise import Structure
from grounded.diagnosis.validation.agreement import is_nowhere
from grounded.diagnosis.validation.bounds import held_up, set_by_bound
from grounded.diagnosis.validation.gain import BETTER, Gain
from grounded.diagnosis.validation.motions import of_no_size, repeats
from grounded.diagnosis.validation.own_numbers import SURE, equations, own_numbers, with_mechanism
from grounded.diagnosis.validation.ruler import Ruler, folds
from grounded.diagnosis.validation.single_steps import borne_out
from grounded.diagnosis.validation.visits import acting, few_trials
from grounded.effects import ParamFamily, SensorDelayFamily, SensorFamily, SensorLagFamily

RIVALS = 8  # likeliest hypotheses that are measured
LEAST = 0.01  # smallest log gain of a cause in its best channel
PAYS = (2.0, LEAST)  # scatters and log gain that a cause must reach
ALONE = (1.0, LEAST)  # the same for a single effect, or calibration, with evidence above SURE
WHITE = 0.9  # tempering factor above which the innovations count as white
OVERRULES = (3.0, 0.1)  # the same for a rival that is likely under another noise structure only
FROM_NONE = (3.0, 0.3)  # the same if the likeliest hypothesis has no cause: that noise is all
SEEN = 0.08  # log gain of a claim, in some channel at some horizon, below which it is not made
SLIGHTLY = (4.0, 0.04)  # scatters and largest log gain from which it may be less, if likely
NO_HELP = 0.005  # mean log gain below which predictions are as good without a cause, or
SPECK = 0.01  # share of what all causes gain
SLIGHT = 0.02  # smallest share of the total gain, in some channel, of a cause that is named
AMOUNTS = 0.1  # a rival's advantage must be this part of what the likeliest gains,
FAR = 1.5  # of at most this log gain (errors down to a quarter) if it has another noise structure
LIKELY = 10.0  # nats from which a dropped effect is reported as doubtful
HARDLY = 0.1  # fraction of a parameter's prior below which it counts as unchanged
RUINS = -2.0  # mean log gain of a cause with which predictions diverge: errors are 7 times larger
REFIT = 12  # iterations after a cause was removed


@dataclass(frozen=True, eq=False)
class Doubtful:
    """A likely effect that was dropped: predictions gain too little, or one motion shows it."""

    name: str
    nats: float
    fit: Fitted  # including the effect
    repeats: int = 0  # trials of the only motion that shows it; 0: dropped for another reason
    alone: int | None = None  # the only trial, in `data.used`, that is predicted better with it


@dataclass(frozen=True, eq=False)
class Decision:
    """The claim: its fit, the crude model's fit, and the fit without each of its causes."""

    search: HypothesisSearch  # restricted to the claim's noise structure, if that overruled
    whole: HypothesisSearch
    fit: Fitted
    crude: Fitted
    without: dict[str, Fitted]  # by effect, or "calibration"
    doubtful: tuple[Doubtful, ...] = ()  # likeliest first

    @property
    def causes(self) -> tuple[str, ...]:
        """The effects of the fit, and calibration if its parameters are free."""
        return causes(self.fit)

    @property
    def held_up(self) -> dict[str, tuple[str, ...]]:
        """By effect, the model's parameters that would end at their bounds without it."""
        kept = {n: held_up(self.search, self.fit, less, n) for n, less in self.without.items()}
        return {n: names for n, names in kept.items() if names}


def causes(fit: Fitted) -> tuple[str, ...]:
    """Return the effects of a fit, and "calibration" if its parameters are free."""
    return (*fit.hypothesis.names, *((CALIBRATION,) if fit.hypothesis.spread > 0 else ()))


def decide(search: HypothesisSearch, best: Fitted, ruler: Ruler, most: int) -> Decision:
    """Choose the hypothesis that held-out predictions support.

    Args:
        search: holds all hypotheses that were fitted.
        best: the likeliest one.
        ruler: measures predictions of the same data.
        most: largest number of effects.
    """
    whole, crude = search, search.exact_null()
    white = search.tempering.factor > WHITE
    ruler.beside(crude)
    search, proposed = _proposed(search, best, crude, ruler, most, white)
    apart = split(search, proposed)
    if apart is not proposed and not ruler.gain(apart, proposed).beyond(*BETTER):
        proposed = apart
    proposed = _by_mechanism(search, _plainest(search, proposed, ruler, white), ruler, white)
    proposed = _of_fewer_inputs(search, proposed, ruler, white)
    proposed = own_numbers(search, proposed, ruler)
    fit, without, doubtful = _pruned(search, proposed, ruler, white)
    if proposed.hypothesis.spread > 0 and (other := _likelier(search, fit, ruler, white)):
        fit, without, more = _pruned(search, other, ruler, white)
        doubtful += more
    if proposed.hypothesis.spread > 0:  # effects were found beside free parameters
        other = own_numbers(search, fit, ruler)
        if other is not fit:
            fit, without, more = _pruned(search, other, ruler, white)
            doubtful += more
    if not _likely(search, fit):
        fit, without, _ = _pruned(search, search.best_null(), ruler, white)
    if causes(fit) and not _seen(search, ruler, crude, fit):
        doubtful += [
            Doubtful(n, nats, fit)
            for n in equations(fit)
            if (nats := search.score(fit) - search.score(without[n])) > LIKELY
        ]
        fit = crude
    if not causes(fit) or not _pays(search, ruler, crude, fit, white):
        search, fit, without = whole, crude, {}
    search.settled([fit, *without.values(), search.best_null()])
    fit, without = search.latest(fit), {name: search.latest(f) for name, f in without.items()}
    open_ = sorted((d for d in doubtful if d.name not in causes(fit)), key=lambda d: -d.nats)
    return Decision(search, whole, fit, crude, without, tuple(open_))


def _plainest(search: HypothesisSearch, fit: Fitted, ruler: Ruler, white: bool) -> Fitted:
    """Replace frictions by their plain forms if their further parameters predict no better.

    A plain form that is as likely, or likelier, gives way only to clearly better predictions: with
    less, the two tie, and of two that tie the simpler is claimed.
    """
    for plain_form in plainer(search, fit) if ruler.held_out else ():
        tied = search.score(plain_form) > search.score(fit) - TIE
        tied = tied and not ruler.gain(plain_form, fit).beyond(*BETTER)
        if tied or not _pays(search, ruler, plain_form, fit, white):
            return _plainest(search, plain_form, ruler, white)
    return fit


def _of_fewer_inputs(search: HypothesisSearch, fit: Fitted, ruler: Ruler, white: bool) -> Fitted:
    """Replace effects of several inputs by those of fewer, while these tie (`parted`).

    If the innovations are not white, the model lacks something else, and a few nats are that.
    """
    for other in parted(search, fit) if ruler.held_out else ():
        tied = search.score(other) > search.score(fit) - (TIE if white else LIKELY)
        if tied and not ruler.gain(other, fit).beyond(*BETTER):
            return _of_fewer_inputs(search, other, ruler, white)
    return fit


def _by_mechanism(search: HypothesisSearch, fit: Fitted, ruler: Ruler, white: bool) -> Fitted:
    """Replace a coupling by a cause with a mechanism that predicts as well (`with_mechanism`)."""
    other = with_mechanism(search, fit)
    if other is None or ruler.gain(other, fit).beyond(*BETTER):
        return fit
    return other if _pays(search, ruler, search.exact_null(), other, white) else fit


def _likelier(search: HypothesisSearch, fit: Fitted, ruler: Ruler, white: bool) -> Fitted | None:
    """After a cause was dropped, find a likelier hypothesis that differs in one effect.

    The effects were selected while the parameters were free, so with exact parameters others may be
    likelier. And of two effects that stand in for each other, the one that predictions needed less
    was dropped, by no more than their scatter, even if it is far likelier alone than the other. A
    changed value of an adopted effect need not predict as well as a new effect: that an adopted
    value is slightly off is known, and an effect that imitates it may fit the rest of the gap too.
    A friction with more values than predictions support is not likelier, but stands for its plain
    form: else it would undo what `_plainest` decided. A motor's plain friction, with a gain that is
    15 % off, was one of 16 % of the load with the right gain.
    """
    h, names = fit.hypothesis, set(fit.hypothesis.names)
    near = [f for f in search.of_size(len(names)) if len(names - {*f.hypothesis.names}) == 1]
    if h.spread > 0:
        others = [f for f in near if f.hypothesis.spread == h.spread]
    else:
        starts = [(replace(f.hypothesis, shift=None, spread=0.0), fit.noise, f.track) for f in near]
        others = search.refined(starts[:RIVALS], REFIT) if starts else []

    def likelier(other: Fitted) -> bool:
        nats = search.score(other) - search.score(fit)
        refused = nats <= TIE * (h.spread > 0) or {*other.hypothesis.names} == names
        added = {*other.hypothesis.names} - names
        refused = refused or any(set_by_bound(search, other, fit, name) for name in added)
        return not refused and not _outdone(ruler.gain(other, fit), _adopted(other, names))

    for other in sorted(filter(likelier, others), key=search.score, reverse=True):
        at_plainest = _plainest(search, other, ruler, white)
        if likelier(at_plainest):
            return at_plainest
    return None


def _outdone(gain: Gain, adopted: bool) -> bool:
    """Check whether predictions refuse a likelier rival.

    If it only changes adopted effects, only a large gain refuses it.
    """
    return gain.beyond(*BETTER) and (gain.mean > BETTER[1] or not adopted)


def _adopted(rival: Fitted, names: set[str]) -> bool:
    """Check whether all that a rival has beside `names` are changes of adopted effects."""
    return all(effect.known for effect in rival.hypothesis.effects if effect.name not in names)


def _likely(search: HypothesisSearch, fit: Fitted) -> bool:
    """Check whether the remaining effects are still likelier than none, without dropped ones."""
    null = search.exact_null() if parametric(fit) else search.best_null()
    return not fit.hypothesis.effects or search.score(fit) > search.score(null) + CLAIM


def _pays(
    search: HypothesisSearch, ruler: Ruler, before: Fitted, after: Fitted, white: bool
) -> bool:
    """Check whether predictions support what `after` has in addition to `before`.

    Predictions a second ahead contain accumulated noise, which hides what single steps show. So
    some effects need only a positive gain if the innovations are white: a further effect with
    evidence above SURE that more than few trials show, and any effect that single steps of several
    trials support. In one long log, an effect that single steps of its pieces support by
    LARGE_GAIN need only not lose. If the innovations are not white, evidence is not enough.
    """
    gain, effects = ruler.gain(before, after), len(after.hypothesis.effects)
    sure = search.score(after) - search.score(before) > SURE
    new = set(after.hypothesis.names) - set(before.hypothesis.names)
    rest = set(after.hypothesis.names) - new
    if new:  # `before` may have been chosen by predictions and not be the likeliest without them
        free = after.hypothesis.spread > 0
        fits = [f for f in search.fits.values() if free or f.hypothesis.spread == 0]
        less = (search.score(f) for f in fits if set(f.hypothesis.names) <= rest)
        sure = sure and search.score(after) - max(less) > CLAIM
    further = effects > max(1, len(before.hypothesis.effects))
    if gain.pays(*(ALONE if sure and effects < 2 else PAYS)):
        return True
    if not (sure and white and new and gain.largest > LEAST) or _as_given(after, new):
        return False
    if further and gain.mean > 0 and _in_several(search, after, new):
        return True
    if gain.mean > 0 and gain.pieces.sum() > 0:
        return borne_out(search, before, after)
    # in one log, values from all pieces but one may miss a rare motion such as an arm's fall
    alone = search.data.count == 1 and gain.mean > -gain.scatter
    return alone and borne_out(search, before, after, LARGE_GAIN)


def _seen(search: HypothesisSearch, ruler: Ruler, crude: Fitted, fit: Fitted) -> bool:
    """Check whether the claim as a whole shows in predictions, in some channel at some horizon.

    Evidence of dozens of nats for causes that change predictions by a few percent was, on blind
    cases, nearly always evidence of something else, unless the innovations are white and the gain
    is many times its scatter. A sensor's fault need not change what comes next: it counts by very
    high evidence alone.
    """
    if not ruler.held_out or (gain := ruler.gain(crude, fit)).largest > SEEN:
        return True
    if search.tempering.factor > WHITE and gain.beyond(*SLIGHTLY):
        return search.score(fit) - search.score(search.best_null()) > LIKELY
    if closes_the_gap(search, ruler, crude, fit):
        return True
    sensed = all(isinstance(e.family, SensorFamily) for e in fit.hypothesis.effects)
    return sensed and search.score(fit) - search.score(search.best_null()) > LARGE_GAIN


def _as_given(fit: Fitted, names: set[str]) -> bool:
    """Check whether all of these are parameters with shifts far below their priors."""
    pairs = [(e, v) for e, v in fit.hypothesis.pairs if e.name in names]
    return all(
        isinstance(e.family, ParamFamily)
        and abs(v["d"]) < HARDLY * e.site.model.params[e.site.target].spread
        for e, v in pairs
    )


def _in_several(search: HypothesisSearch, fit: Fitted, names: set[str]) -> bool:
    """Check whether more than few trials show each of these effects of a fit."""
    return not any(few_trials(search.data, acting(search.predictor, fit, n)) for n in names)


def _beyond_doubt(search: HypothesisSearch, found: Fitted, rival: Fitted) -> bool:
    """Check whether single steps reject a less likely rival with the same noise and freedom.

    For white innovations only. Noise and parameters then hide nothing from one hypothesis that they
    don't hide from the other, and predictions a second ahead are a coarser test of the same.
    """
    same = rival.noise.structure == found.noise.structure
    same = same and rival.hypothesis.spread == found.hypothesis.spread
    sure = search.score(found) - search.score(rival) > SURE
    return same and sure and borne_out(search, rival, found)


def _overrules(
    ruler: Ruler, crude: Fitted, found: Fitted, rival: Fitted, *bar: float, far: float = np.inf
) -> bool:
    """Check whether a less likely rival predicts better significantly and by enough."""
    more, whole = ruler.gain(found, rival), ruler.gain(crude, found).mean
    return more.beyond(*bar) and more.mean > AMOUNTS * min(whole, far)


def _proposed(
    search: HypothesisSearch, best: Fitted, crude: Fitted, ruler: Ruler, most: int, white: bool
) -> tuple[HypothesisSearch, Fitted]:
    """Return the likeliest hypothesis, or a rival that predicts clearly better, with its search."""
    if not ruler.held_out:
        return search, best
    null, score = search.best_null(), search.score
    size = len(best.hypothesis.effects)  # larger sets did not pay by evidence
    rivals = [f for k in range(1, size + 1) for f in search.of_size(k) if f is not best]
    rivals = [f for f in rivals if score(f) > score(null) + CLAIM]
    rivals = sorted(rivals, key=lambda f: -score(f))[:RIVALS]
    if search.calibrates():
        rivals.append(null)
    found, at = best, search
    for rival in rivals:
        if _overrules(ruler, crude, found, rival, *BETTER):
            found = found if white and _beyond_doubt(search, found, rival) else rival
    for structure, spread in dict.fromkeys((s, w) for s, w, _ in search.fits):
        other = search.under(structure, spread)
        if other is None or (structure, spread) == (best.noise.structure, best.hypothesis.spread):
            continue
        rival = other.chosen(most)
        bar = OVERRULES if causes(found) else FROM_NONE
        if causes(rival) and _overrules(ruler, crude, found, rival, *bar, far=FAR):
            if rival.hypothesis.effects:
                other.finished(other.of_size(len(rival.hypothesis.effects))[:2], TO_THE_TOP)
                rival = other.chosen(most)
            found, at = rival, other
    return at, found


def _pruned(
    search: HypothesisSearch, fit: Fitted, ruler: Ruler, white: bool
) -> tuple[Fitted, dict[str, Fitted], list[Doubtful]]:
    """Drop the causes that predictions don't need, the least needed first.

    Returns:
        The fit, the fits without each of its causes, and the likely effects that were dropped.
    """
    doubtful: list[Doubtful] = []
    while True:
        without = {name: fit_without(search, fit, name, ruler) for name in causes(fit)}
        if not ruler.held_out:
            return fit, without, doubtful
        gains = {name: ruler.gain(less, fit) for name, less in without.items()}
        least = SLIGHT * ruler.since_outset(fit)
        undone = counterparts(search.predictor, fit.hypothesis) or [
            n for n in fit.hypothesis.names if set_by_bound(search, fit, without[n], n)
        ]
        repeated = {n: repeats(search, fit, without[n], n) for n in equations(fit)}
        repeated |= {n: 0 for n, k in repeated.items() if k and _whole(search, fit, without[n], n)}
        idle = (
            undone
            or [n for n, count in repeated.items() if count]
            or [n for n in equations(fit) if is_nowhere(fit, search.data, n)]
            or [n for n, gain in gains.items() if gain.mean < RUINS]
            or of_no_size(search.predictor, fit, folds(search.data))
            or [
                name
                for name, less in without.items()
                if not _pays(search, ruler, less, fit, white)
                or (
                    _of_no_account(search, gains[name], least)
                    and not _missed(search, ruler, fit, name, less, least)
                )
            ]
        )
        if not undone:  # what loses nothing is not needed, whatever its evidence
            helps = {n for n in idle if gains[n].mean > 0}
            idle = [n for n in idle if n not in helps or not held_up(search, fit, without[n], n)]
        if not idle:
            return fit, without, doubtful
        name = _least_needed(search, ruler, without, min(idle, key=lambda n: gains[n].mean), idle)
        nats = search.score(fit) - search.score(without[name])
        if nats > LIKELY and name in equations(fit) and name not in undone:
            doubtful.append(Doubtful(name, nats, fit, repeated[name], gains[name].alone))
        fit = without[name]


def _of_no_account(search: HypothesisSearch, gain: Gain, least: float) -> bool:
    """Check whether a cause gains next to nothing of what all causes gain.

    In one log, the mean is not asked: all pieces but one may miss a rare motion.
    """
    some = search.data.count > 1
    return bool(gain.channels.max() < least) or (
        some and gain.mean < max(NO_HELP, SPECK * least / SLIGHT)
    )


def _missed(
    search: HypothesisSearch, ruler: Ruler, fit: Fitted, name: str, less: Fitted, least: float
) -> bool:
    """Check whether a cause of little account is missed, beside white innovations.

    A sensor that is late shows in its own channel only, which the mean over all channels hides:
    there it counts, if it is very likely. And a leftover that only the rest without a cause has is
    no gap "that no known effect explains".
    """
    effect = next((e for e in fit.hypothesis.effects if e.name == name), None)
    late = effect is not None and isinstance(effect.family, SensorDelayFamily | SensorLagFamily)
    late = late and search.tempering.factor > WHITE
    very_likely, gain = search.score(fit) - search.score(less) > LARGE_GAIN, ruler.gain(less, fit)
    if late and very_likely and gain.mean > 0 and gain.channels.max() >= least:
        return True
    return closes_the_gap(search, ruler, less, fit)


def closes_the_gap(search: HypothesisSearch, ruler: Ruler, less: Fitted, fit: Fitted) -> bool:
    """Check whether predictions gain, and nothing is left with a fit where a gap is without it.

    Beside white innovations only. Both leftovers are scored on trials that were held out, and the
    first one is of a state whose errors matter, with a correction that improves predictions, as of
    a gap that is told.
    """
    likely = search.tempering.factor > WHITE and search.score(fit) - search.score(less) > SURE
    if not likely or ruler.gain(less, fit).mean <= 0:
        return False
    left = leftovers(search.predictor, less)
    left = [one for one in left if not ruler.negligible(less, one.channel)]
    told = corrections(ruler, less, left) if left else {}
    return bool(told) and not leftovers(search.predictor, fit)


def _whole(search: HypothesisSearch, fit: Fitted, less: Fitted, name: str) -> bool:
    """Check whether one coefficient times a measured signal explains all that is left without it.

    Along a single motion, what the model lacks may be a function of time or of any state. But no
    other function is proportional to this signal at every step; so it counts as seen if nothing is
    left beside it and every effect that was tried in its place is clearly less likely.
    """
    h = fit.hypothesis
    effect = h.effects[h.names.index(name)]
    if len(effect.free) > 1 or getattr(effect.family, "timed", False):
        return False
    rest, own = set(h.names) - {name}, search.score(fit)
    rivals = [f for f in search.of_size(len(h.names)) if {*f.hypothesis.names} - rest != {name}]
    rivals = [f for f in rivals if rest <= set(f.hypothesis.names)]
    if own - search.score(less) < LARGE_GAIN or any(own - search.score(f) < SURE for f in rivals):
        return False
    return not leftovers(search.predictor, fit)


def _least_needed(
    search: HypothesisSearch, ruler: Ruler, without: dict[str, Fitted], name: str, idle: list[str]
) -> str:
    """Return which of the causes that can be dropped leaves the likeliest rest.

    They can stand in for each other, so evidence decides unless predictions clearly do.
    """
    for other in idle:
        likelier = search.score(without[other]) - search.score(without[name]) > TIE
        if likelier and not ruler.gain(without[other], without[name]).beyond(*BETTER):
            name = other
    return name


def fit_without(search: HypothesisSearch, fit: Fitted, name: str, ruler: Ruler) -> Fitted:
    """Refit without one cause.

    Of the likeliest fit under any noise structure and the likeliest under the fit's own, return the
    one that predicts better: a cause gets no credit for what the rest can do under another noise.
    """
    h, own, dt = fit.hypothesis, fit.noise.structure, search.data.dt
    less = replace(h, shift=None, spread=0.0) if name == CALIBRATION else h.minus(name)
    names = tuple(sorted(less.names))
    for structure in dict.fromkeys((own, search.best_null().noise.structure)):
        known = search.fits.get((structure, less.spread, names))
        noise = fit.noise if structure == own else fit.noise.allowing(structure, dt)
        starts: list[Fitted | tuple] = [(less, noise, fit.track)]  # type: ignore[type-arg]
        if structure == own or known is None:
            search.refined([*starts, known] if known else starts, REFIT)
    fits = [
        (f, s == own and w == less.spread)
        for (s, w, n), f in search.fits.items()
        if n == names and (w > 0) == (less.spread > 0)
    ]
    if not fits:
        return search.exact_null()
    crude, near = search.exact_null(), [f for f, same in fits if same]
    likely = [max(some, key=search.score) for some in ([f for f, _ in fits], near) if some]
    return max(likely, key=lambda f: ruler.gain(crude, f).mean)


def plain(search: HypothesisSearch, fit: Fitted) -> Fitted:
    """Return the same hypothesis under white noise."""
    h = fit.hypothesis
    if fit.noise.structure == Structure():
        return fit
    known = search.fits.get((Structure(), h.spread, tuple(sorted(h.names))))
    noise = fit.noise.allowing(Structure(), search.data.dt)
    found = [known] if known else search.refined([(h, noise, fit.track)], REFIT)
    return found[0] if found else fit
