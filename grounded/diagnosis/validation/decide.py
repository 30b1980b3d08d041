"""Evidence proposes, the ruler decides: which hypothesis is claimed, what each cause is worth.

The likeliest hypothesis can be wrong in ways that evidence does not see. Noise that may be
coloured, or parameters that may move, explain a lasting effect away that predictions a second ahead
still miss. A further effect takes up what is left somewhere and predicts no better. Values that one
trial alone determines make predictions of the others worse. Far from the floor, likelihoods are
those of a wrong model, and thousands of nats are no certainty. So the likeliest ones, and the
likeliest of every other structure of noise, are held against the `ruler`:

    a rival takes the place of the likeliest only where it predicts clearly better
    a cause without which predictions are as good, within their scatter, is dropped; a further
    effect that is beyond doubt, where white noise is all that is left, only if they gain nothing
    an effect that a parameter's shift undoes is dropped: the parameter alone does both
    one without a mechanism that a single motion shows is dropped, however often that was repeated
    what is left then must be likelier than none by itself
    what predicts no better than the crude model is not claimed at all
    a likely effect that was dropped is doubtful: seen in too few trials, maybe

A cause is an effect or the calibration of the model's own parameters. Its credit is what is lost
without it, the others fitted again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.diagnosis.hypotheses.counterpart import counterparts
from grounded.diagnosis.hypotheses.explored import CLAIM, TIE, parametric
from grounded.diagnosis.hypotheses.plainest import plainer
from grounded.diagnosis.hypotheses.search import LARGE_GAIN, TO_THE_TOP, HypothesisSearch
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.noise import Structure
from grounded.diagnosis.validation.motions import of_no_size, repeats
from grounded.diagnosis.validation.ruler import Ruler, folds
from grounded.diagnosis.validation.single_steps import borne_out
from grounded.diagnosis.validation.visits import acting, few_trials
from grounded.effects import ParamFamily

CALIBRATION = "calibration"
RIVALS = 8  # likeliest hypotheses that are measured
LEAST = 0.01  # gain that a cause must have in one channel
PAYS = (2.0, LEAST)  # scatters that it must gain, and that
ALONE = (1.0, LEAST)  # the same of the only effect, or of calibration, that is beyond doubt
SURE = 8.0  # nats, odds of 3,000 to 1, from which an effect is likely beyond doubt
WHITE = 0.9  # of a nat is believed where what is left is white noise
BETTER = (2.0, 0.05)  # the same for a rival to take the place of a likelier hypothesis
OVERRULES = (3.0, 0.1)  # and for a claim that is likely under another noise only
SLIGHT = 0.02  # of what all causes gain, adopted ones too: less in each channel is not named
AMOUNTS = 0.1  # of what the likeliest gains: what a rival has to gain beyond it
FAR = 1.5  # of that, in logs of errors (to a quarter): more asks no more of another noise's claim
LIKELY = 10.0  # nats from which a dropped effect is mentioned
HARDLY = 0.1  # of its own prior: a parameter that is off by less is as it was given
REFIT = 12  # iterations after a cause was taken out


@dataclass(frozen=True, eq=False)
class Doubtful:
    """A likely effect that was dropped: predictions gain too little, or one motion shows it."""

    name: str
    nats: float
    fit: Fitted  # with it
    repeats: int = 0  # trials that make the motion that bears it out; 0: few trials do


@dataclass(frozen=True, eq=False)
class Decision:
    """What is claimed: its fit, the crude model's, and the fit without each of its causes."""

    search: HypothesisSearch  # under the claim's own noise, where another one overruled
    whole: HypothesisSearch
    fit: Fitted
    crude: Fitted
    without: dict[str, Fitted]  # by effect, or "calibration"
    doubtful: tuple[Doubtful, ...] = ()  # likeliest first

    @property
    def causes(self) -> tuple[str, ...]:
        """Effects and calibration, whatever the fit has of both."""
        return causes(self.fit)


def causes(fit: Fitted) -> tuple[str, ...]:
    """What a fit explains by: its effects, and calibration where its parameters moved."""
    return (*fit.hypothesis.names, *((CALIBRATION,) if fit.hypothesis.spread > 0 else ()))


def decide(search: HypothesisSearch, best: Fitted, ruler: Ruler, most: int) -> Decision:
    """The claim that held-out predictions bear out.

    Args:
        search: with all hypotheses that were fitted.
        best: the likeliest one.
        ruler: of the same data.
        most: so many effects at most.
    """
    whole, crude = search, search.exact_null()
    white = search.tempering.factor > WHITE
    ruler.beside(crude)
    search, proposed = _proposed(search, best, crude, ruler, most, white)
    proposed = _own_numbers(search, _plainest(search, proposed, ruler, white), ruler)
    fit, without, doubtful = _pruned(search, proposed, ruler, white)
    if proposed.hypothesis.spread > 0 and (other := _likelier(search, fit, ruler)):
        fit, without, more = _pruned(search, other, ruler, white)
        doubtful += more
    if not _likely(search, fit):
        fit, without, _ = _pruned(search, search.best_null(), ruler, white)
    if not causes(fit) or not _pays(search, ruler, crude, fit, white):
        search, fit, without = whole, crude, {}
    open_ = sorted((d for d in doubtful if d.name not in causes(fit)), key=lambda d: -d.nats)
    return Decision(search, whole, fit, crude, without, tuple(open_))


def _plainest(search: HypothesisSearch, fit: Fitted, ruler: Ruler, white: bool) -> Fitted:
    """The fit with frictions at their plainest where what they have more predicts no better."""
    for plain_form in plainer(search, fit) if ruler.held_out else ():
        if not _pays(search, ruler, plain_form, fit, white):
            return _plainest(search, plain_form, ruler, white)
    return fit


def _own_numbers(search: HypothesisSearch, fit: Fitted, ruler: Ruler) -> Fitted:
    """The fit with a parameter in the place of each effect that ties with its shift, or with all.

    A number that its owner calls uncertain is off sooner than the equations lack something, and so
    is an adopted delay.
    """
    h, score = fit.hypothesis, search.score
    params = {e.name for e in search.candidates if e.known or isinstance(e.family, ParamFamily)}
    for name in [n for n in _effects(fit) if n not in params] if h.spread == 0 else ():
        rest = {*h.names} - {name}
        sets = {tuple(sorted({*rest, param})) for param in params - rest}

        def likeliest(sets: set[tuple[str, ...]] = sets) -> Fitted:
            exact = [f for (_, w, names), f in search.fits.items() if names in sets and not w]
            return max(exact, key=score, default=fit)

        if score(fit) - score(likeliest()) < 2 * TIE:
            search.finished([likeliest()], TO_THE_TOP)
        other = likeliest()
        ties = other is not fit and score(fit) - score(other) < TIE
        if ties and not ruler.gain(other, fit).beyond(*BETTER):
            return _own_numbers(search, other, ruler)
    return _calibrated_instead(search, fit, ruler)


def _calibrated_instead(search: HypothesisSearch, fit: Fitted, ruler: Ruler) -> Fitted:
    """The fit with the model's parameters calibrated in the place of a further effect.

    Where all of them are off by a little no single shift is as good as an effect of two numbers,
    but together they are. So beside another cause an effect has to be likelier beyond doubt.
    """
    h, score, names = fit.hypothesis, search.score, _effects(fit)
    rests = [tuple(sorted({*h.names} - {name})) for name in names if len(names) > 1]
    if h.spread > 0 or not rests:
        return fit

    def likeliest() -> Fitted:
        free = [f for (_, w, some), f in search.fits.items() if w and some in rests]
        return max(free, key=score, default=fit)

    if score(fit) - score(likeliest()) < 2 * SURE:
        search.finished([likeliest()], TO_THE_TOP)
    other = likeliest()
    as_good = other is not fit and score(fit) - score(other) < SURE
    return fit if not as_good or ruler.gain(other, fit).beyond(*BETTER) else other


def _likelier(search: HypothesisSearch, fit: Fitted, ruler: Ruler) -> Fitted | None:
    """Where a calibration was dropped: what is likelier than one of the effects without it, too.

    Which effect goes best with the others was asked beside parameters that were free to help.
    """
    h, names = fit.hypothesis, set(fit.hypothesis.names)
    near = [f for f in search.of_size(len(names)) if len(names - {*f.hypothesis.names}) == 1]
    if h.spread > 0 or not near:
        return None
    starts = [(replace(f.hypothesis, shift=None, spread=0.0), fit.noise, f.track) for f in near]
    others = [
        f for f in search.refined(starts[:RIVALS], REFIT) if search.score(f) > search.score(fit)
    ]
    others = [f for f in others if not ruler.gain(f, fit).beyond(*BETTER)]
    return max(others, key=search.score, default=None)


def _likely(search: HypothesisSearch, fit: Fitted) -> bool:
    """Whether evidence still asks for the effects that are left: others may have carried them."""
    null = search.exact_null() if parametric(fit) else search.best_null()
    return not fit.hypothesis.effects or search.score(fit) > search.score(null) + CLAIM


def _pays(
    search: HypothesisSearch, ruler: Ruler, before: Fitted, after: Fitted, white: bool
) -> bool:
    """Whether predictions bear out what `after` has beyond `before`.

    A second ahead noise that has added up hides what single steps show. So where nothing but white
    noise is left, a further effect that is likely beyond doubt, and not for one trial alone, need
    only gain anything; so need any effect that single steps of several trials bear out, and of one
    long log one that those of its pieces bear out by far need only not lose. Where more is left,
    thousands of nats are no certainty.
    """
    gain, effects = ruler.gain(before, after), len(after.hypothesis.effects)
    sure = search.score(after) - search.score(before) > SURE
    new = set(after.hypothesis.names) - set(before.hypothesis.names)
    rest = set(after.hypothesis.names) - new
    if new:  # `before` may be what predicts better, and not the likeliest without it
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
    # of one log the values without one of its pieces may predict an arm's fall no better
    alone = search.data.count == 1 and gain.mean > -gain.scatter
    return alone and borne_out(search, before, after, LARGE_GAIN)


def _as_given(fit: Fitted, names: set[str]) -> bool:
    """Whether all of these are parameters that are hardly off by what they are uncertain."""
    pairs = [(e, v) for e, v in fit.hypothesis.pairs if e.name in names]
    return all(
        isinstance(e.family, ParamFamily)
        and abs(v["d"]) < HARDLY * e.site.model.params[e.site.target].spread
        for e, v in pairs
    )


def _in_several(search: HypothesisSearch, fit: Fitted, names: set[str]) -> bool:
    """Whether more than few trials show each of these effects of a fit."""
    return not any(few_trials(search.data, acting(search.predictor, fit, n)) for n in names)


def _beyond_doubt(search: HypothesisSearch, found: Fitted, rival: Fitted) -> bool:
    """Whether steps of several trials tell a rival under the same noise from what is likelier.

    Where nothing but white noise is left: neither noise nor parameters can hide a gap from the one
    that they don't hide from the other, and a second ahead is a coarser look at the same.
    """
    same = rival.noise.structure == found.noise.structure
    same = same and rival.hypothesis.spread == found.hypothesis.spread
    sure = search.score(found) - search.score(rival) > SURE
    return same and sure and borne_out(search, rival, found)


def _overrules(
    ruler: Ruler, crude: Fitted, found: Fitted, rival: Fitted, *bar: float, far: float = np.inf
) -> bool:
    """Whether predictions bear out a less likely hypothesis, by an amount that matters."""
    more, whole = ruler.gain(found, rival), ruler.gain(crude, found).mean
    return more.beyond(*bar) and more.mean > AMOUNTS * min(whole, far)


def _proposed(
    search: HypothesisSearch, best: Fitted, crude: Fitted, ruler: Ruler, most: int, white: bool
) -> tuple[HypothesisSearch, Fitted]:
    """The likeliest hypothesis, or one that predicts clearly better."""
    if not ruler.held_out:
        return search, best
    null, score = search.best_null(), search.score
    size = len(best.hypothesis.effects)  # a larger set would have to pay by evidence too
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
        if causes(rival) and _overrules(ruler, crude, found, rival, *OVERRULES, far=FAR):
            if rival.hypothesis.effects:
                other.finished(other.of_size(len(rival.hypothesis.effects))[:2], TO_THE_TOP)
                rival = other.chosen(most)
            found, at = rival, other
    return at, found


def _pruned(
    search: HypothesisSearch, fit: Fitted, ruler: Ruler, white: bool
) -> tuple[Fitted, dict[str, Fitted], list[Doubtful]]:
    """Without the causes that predictions don't need, the least needed first; the likely ones."""
    doubtful: list[Doubtful] = []
    while True:
        without = {name: fit_without(search, fit, name, ruler) for name in causes(fit)}
        if not ruler.held_out:
            return fit, without, doubtful
        gains = {name: ruler.gain(less, fit) for name, less in without.items()}
        least = SLIGHT * ruler.since_outset(fit)
        undone = counterparts(search.predictor, fit.hypothesis)
        repeated = {n: repeats(search, fit, without[n], n) for n in _effects(fit)}
        idle = (
            undone
            or [n for n, count in repeated.items() if count]
            or of_no_size(search.predictor, fit, folds(search.data))
            or [
                name
                for name, less in without.items()
                if gains[name].channels.max() < least or not _pays(search, ruler, less, fit, white)
            ]
        )
        if not idle:
            return fit, without, doubtful
        name = _least_needed(search, ruler, without, min(idle, key=lambda n: gains[n].mean), idle)
        nats = search.score(fit) - search.score(without[name])
        if nats > LIKELY and name in _effects(fit) and name not in undone:
            doubtful.append(Doubtful(name, nats, fit, repeated[name]))
        fit = without[name]


def _least_needed(
    search: HypothesisSearch, ruler: Ruler, without: dict[str, Fitted], name: str, idle: list[str]
) -> str:
    """Of causes that can each be spared, the one without which the rest is likeliest.

    Each does the others' work: unless predictions tell what is left, evidence does.
    """
    for other in idle:
        likelier = search.score(without[other]) - search.score(without[name]) > TIE
        if likelier and not ruler.gain(without[other], without[name]).beyond(*BETTER):
            name = other
    return name


def _effects(fit: Fitted) -> list[str]:
    """Those that are no parameters."""
    return [e.name for e in fit.hypothesis.effects if not isinstance(e.family, ParamFamily)]


def fit_without(search: HypothesisSearch, fit: Fitted, name: str, ruler: Ruler) -> Fitted:
    """The same without one cause, all the rest fitted again, under the noise that it then has.

    Of the likeliest of all and the likeliest under noise of the fit's own structure, the one that
    predicts better: what another noise lets the rest do is not the cause's credit.
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
    """The same hypothesis under white noise."""
    h = fit.hypothesis
    if fit.noise.structure == Structure():
        return fit
    known = search.fits.get((Structure(), h.spread, tuple(sorted(h.names))))
    noise = fit.noise.allowing(Structure(), search.data.dt)
    found = [known] if known else search.refined([(h, noise, fit.track)], REFIT)
    return found[0] if found else fit


def shares(ruler: Ruler, decision: Decision) -> dict[str, float]:
    """The share of what predictions gain in all (log of the error) that is lost without each cause.

    Where causes overlap the shares add to less than 1; where they help one another, each as much
    as it adds to the sum.
    """
    whole = ruler.gain(decision.crude, decision.fit).mean
    lost = {n: max(ruler.gain(f, decision.fit).mean, 0.0) for n, f in decision.without.items()}
    return {name: loss / max(whole, sum(lost.values()), 1e-12) for name, loss in lost.items()}


def ordered(shares_: dict[str, float], names: Sequence[str]) -> list[str]:
    """Names by their credit, largest first."""
    return sorted(names, key=lambda name: -shares_.get(name, 0.0))
