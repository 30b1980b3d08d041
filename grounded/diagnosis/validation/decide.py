"""From the fitted hypotheses to a decision: options for the rule (`choose`), and guards.

Evidence proposes, held-out predictions decide. The likeliest hypothesis can be wrong in ways that
its evidence does not show: coloured noise or free parameters can absorb a persistent effect that
predictions a second ahead still miss, and far above the noise floor likelihoods are those of a
wrong model. So the likeliest hypotheses of every size, with and without free parameters, and every
set that one of their causes less makes, are measured by the `ruler`; `choose` picks one.

A guard refuses a cause whatever it gains:

    no size    none of its values differs from zero by SURE standard deviations
    one group  only one of several groups of trials shows it, or all trials are of one group and
               it names no mechanism (`Family.loose`)
    refuted    it limits a rate that the log exceeds, or that no command reaches (`no_limits`)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from grounded.diagnosis.error_report import CALIBRATION
from grounded.diagnosis.hypotheses.explored import no_limits, sizeless
from grounded.diagnosis.hypotheses.leftover import Leftover, corrections, leftovers
from grounded.diagnosis.hypotheses.lookalike import Likeness, lookalikes
from grounded.diagnosis.hypotheses.search import TO_THE_TOP, HypothesisSearch
from grounded.diagnosis.levels import NATS, PICKED, SURE
from grounded.diagnosis.likelihood.fitted import Fitted, leave_one_out
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.intervals import NORMAL, fisher
from grounded.diagnosis.likelihood.noise import Structure
from grounded.diagnosis.validation.choose import Choice, Errors, Option, Rule
from grounded.diagnosis.validation.ruler import Ruler
from grounded.effects import ParamFamily
from grounded.frozen import Array

MEASURED = 4  # likeliest sets of each size, with and without free parameters, that are measured
REFIT = 12  # iterations after a cause was removed
LIKELIER_AT_MOST = 50.0  # most nats by which another fit counts as likelier


@dataclass(frozen=True, eq=False)
class Doubtful:
    """A likely effect that is not claimed, since only one group of trials shows it."""

    name: str
    nats: float
    fit: Fitted  # including the effect
    trials: tuple[int, ...]  # of the group


@dataclass(frozen=True, eq=False)
class Decision:
    """The claim: its fit, the crude model's fit, and the fit without each of its causes."""

    search: HypothesisSearch
    fit: Fitted
    crude: Fitted
    without: dict[str, Fitted]  # by effect, or "calibration"
    lost: dict[str, float]  # evidence without it, by cause [nats]
    choice: Choice
    doubtful: tuple[Doubtful, ...]  # likeliest first
    left: tuple[Leftover, ...]  # structure that the claim leaves
    flexible: dict[str, tuple[Leftover, Errors]]  # of it, what predictions gain by, by channel
    alike: tuple[Likeness, ...] = ()  # look-alikes of the claim (`beside_lookalikes`)

    @property
    def gap(self) -> bool:
        """Whether the claim leaves structure that a flexible correction predicts."""
        return bool(self.left)

    @property
    def leader(self) -> str:
        """The effect of the claim that is likeliest alone, from which a search begins; "": none."""
        alone = [fit.hypothesis.names[0] for fit in self.search.of_size(1)]
        return next((name for name in alone if name in self.fit.hypothesis.names), "")

    @property
    def causes(self) -> tuple[str, ...]:
        """The effects of the fit, and calibration if its parameters are free."""
        return causes(self.fit)


def causes(fit: Fitted) -> tuple[str, ...]:
    """Return the effects of a fit, and "calibration" if its parameters are free."""
    return (*fit.hypothesis.names, *((CALIBRATION,) if fit.hypothesis.spread > 0 else ()))


def equations(fit: Fitted) -> list[str]:
    """Return the names of the effects that are not parameters."""
    return [e.name for e in fit.hypothesis.effects if not isinstance(e.family, ParamFamily)]


def decide(search: HypothesisSearch, ruler: Ruler) -> Decision:
    """Choose the hypothesis that held-out predictions support.

    Args:
        search: holds all hypotheses that were fitted; sets of fewer causes are added.
        ruler: measures predictions of the same data.
    """
    ruler.beside(search.exact_null())
    options = Options(search, ruler)
    hopeful, outset = options.hopeful(), ruler.outset
    rule = Rule(
        hopeful,
        ruler.compared,
        options.nats,
        options.less,
        held_out=ruler.held_out,
        outset=outset,
    )
    choice = rule.choose()
    while vague := options.vague(choice.chosen):
        rule.refuse(choice.chosen, vague)
        choice = rule.choose()
    own = choice.chosen.causes
    fit, crude = options.fits[own], options.fits[frozenset()]
    rest = {c: one for c in own if (one := options.less(choice.chosen, c))}
    less = {c: options.fits[one.causes] for c, one in rest.items()}
    search.settled([fit, *less.values(), search.best_null()])
    fit, less = search.latest(fit), {c: search.latest(less[c]) for c in causes(fit)}
    left = leftovers(search.predictor, fit)
    return Decision(
        search,
        fit,
        search.latest(crude),
        less,
        {c: options.nats(one, choice.chosen) for c, one in rest.items()},
        choice,
        _doubtful(options, rule, choice),
        tuple(left),
        corrections(ruler, fit, left),
    )


def beside_lookalikes(decision: Decision) -> Decision:
    """Return a decision with the look-alikes of its claim, each fitted in its effect's place.

    So ties are told between converged fits, and the report fits nothing.
    """
    return replace(decision, alike=lookalikes(decision.search, decision.fit))


class Options:
    """The fitted sets of causes as options of the rule."""

    def __init__(self, search: HypothesisSearch, ruler: Ruler) -> None:
        self.search, self.ruler = search, ruler
        self.fits: dict[frozenset[str], Fitted] = {frozenset(): search.exact_null()}
        self._known: dict[frozenset[str], Option] = {}
        self._sizeless: dict[frozenset[str], list[str]] = {}

    def hopeful(self) -> list[Option]:
        """Return the likeliest sets of each size, with and without free parameters.

        Those under white noise are ranked for themselves: coloured noise may be likelier by far,
        and hide what predictions need.
        """
        count = dict[tuple[int, bool, bool], int]()
        for fit in sorted(self.search.fits.values(), key=self.search.score, reverse=True):
            own, h = frozenset(causes(fit)), fit.hypothesis
            kind = len(h.names), h.spread > 0, fit.noise.structure == Structure()
            if not np.isfinite(self.search.score(fit)) or not own:
                continue
            count[kind] = count.get(kind, 0) + 1
            if own not in self.fits and count[kind] <= MEASURED:
                self.fits[own] = self._best(own)
        # the likeliest without what the log refutes, and with exact parameters
        for own in [own for own in self.fits if own]:
            rest: frozenset[str] | None = own
            for cause in self._refuted(own):
                rest = self._fitted_without(rest, cause) if rest else None
            if rest and CALIBRATION in rest:
                self._fitted_without(rest, CALIBRATION)
        return [self.option(own) for own in list(self.fits) if not self._refuted(own)]

    def _refuted(self, own: frozenset[str]) -> list[str]:
        return no_limits(self.search.data, self.fits[own].hypothesis)

    def _fitted_without(self, causes_: frozenset[str], cause: str) -> frozenset[str] | None:
        """Fit a set without one cause, if it was not; return its causes, None if that fails."""
        own, fit, search = causes_ - {cause}, self.fits[causes_], self.search
        structure = fit.noise.structure
        known = any(f.noise.structure == structure for f in self._of(own))
        if not known and (own not in self.fits or structure == Structure()):
            h = fit.hypothesis
            free = replace(h, shift=None, spread=0.0) if cause == CALIBRATION else h.minus(cause)
            search.refined([(free, fit.noise, fit.track)], REFIT)
            self._known.pop(own, None)
            self.fits.pop(own, None)
        if own not in self.fits and self._of(own):
            self.fits[own] = self._best(own)
        return own if own in self.fits else None

    def _of(self, own: frozenset[str]) -> list[Fitted]:
        """Return the fits of a set of causes, likeliest first."""
        fits = [f for f in self.search.fits.values() if frozenset(causes(f)) == own]
        return sorted(fits, key=self.search.score, reverse=True)

    def _best(self, own: frozenset[str]) -> Fitted:
        """Return the likeliest fit of a set, or that under white noise if it predicts better."""
        likeliest, *others = self._of(own)
        white = [fit for fit in others if fit.noise.structure == Structure()]
        if likeliest.noise.structure == Structure() or not white or not self.ruler.held_out:
            return likeliest
        return white[0] if self.ruler.gain(likeliest, white[0]).clear else likeliest

    def option(self, own: frozenset[str]) -> Option:
        """Return a set of causes as an option."""
        if own not in self._known:
            fit = self.fits[own]
            new = [e for e in fit.hypothesis.effects if not e.known]
            new = [e for e in new if not isinstance(e.family, ParamFamily)]
            order = sum(1 + e.family.loose for e in new), sum(len(e.site.targets) for e in new)
            self._known[own] = Option(own, self.ruler.errors(fit), order)
        return self._known[own]

    def vague_alone(self, own: frozenset[str]) -> list[str]:
        """Return the effects of a set that have no size by its own fit; parameters have priors."""
        if own not in self._sizeless:
            fit = self.fits[own]
            self._sizeless[own] = self._no_size(fit, self.search.sure(fit)[0])
        return self._sizeless[own]

    def vague(self, option: Option) -> list[str]:
        """Return the effects without a size if all likely fits of the same effects are asked."""
        fit = self.fits[option.causes]
        if not fit.hypothesis.effects:
            return []
        return self._no_size(fit, averaged(self.search, fit, self.ruler)[0])

    def _no_size(self, fit: Fitted, std: Array) -> list[str]:
        return [n for n in sizeless(fit.hypothesis, std) if n in equations(fit)]

    def less(self, option: Option, cause: str) -> Option | None:
        """Return a set without one cause, fitted from the values and the noise of the larger one.

        Otherwise the cause would be credited with what better values of the others gain. None if
        the rest can't be filtered, or if a guard refuses the cause.
        """
        own = self._fitted_without(option.causes, cause)
        if own is None or cause in self.vague_alone(option.causes):
            return None
        if cause != CALIBRATION and one_group(self.search, self.fits[option.causes], cause):
            return None
        return self.option(own)

    def nats(self, before: Option, after: Option) -> float:
        """Return how much likelier a second set is, under the likeliest noise of either [nats].

        A cause gets no credit for what the rest can do under another noise. So the second set is
        fitted under that of the first, too.
        """
        likeliest, known = self._of(before.causes)[0], self._of(after.causes)
        structure = likeliest.noise.structure
        if structure not in {fit.noise.structure for fit in known}:
            fit = self.fits[after.causes]
            self.search.refined([(fit.hypothesis, likeliest.noise, fit.track)], REFIT)
            known = self._of(after.causes)
        return self.search.score(known[0]) - self.search.score(likeliest)


def one_group(search: HypothesisSearch, fit: Fitted, name: str) -> tuple[int, ...]:
    """Return the trials of the only group that shows an effect; none if several do.

    By the trials outside that group, it has no size. Where all trials are of one group, no effect
    can be asked for a second one but those that name no mechanism: along one motion, any error of
    the model is the same function of time and of every state, and each repeat raises the evidence
    of an effect that fits it. (Of a single log, its pieces are the groups.)
    """
    data, h, worth = search.data, fit.hypothesis, search.tempering.factor
    i = h.names.index(name)
    family, own = h.effects[i].family, h.sizes[i]
    several = len(data.groups) > 1 and not isinstance(family, ParamFamily)
    if not (family.loose or several):
        return ()
    group = data.folds if data.count == 1 else data.group_of[data.trial_of]
    for g, shift in zip(np.unique(group), leave_one_out(fit, group), strict=True):
        others = worth * fit.gram[group != g].sum(axis=0) + np.diag(fit.prior)
        if (np.abs(h.theta[own] + shift[own]) < SURE * fisher(others)[own]).all():
            return tuple(np.unique(data.trial_of[group == g]).tolist())
    return ()


def _doubtful(options: Options, rule: Rule, choice: Choice) -> tuple[Doubtful, ...]:
    """Return the effects that are likely beside the choice but in one group, likeliest first."""
    found, own, search = list[Doubtful](), choice.chosen.causes, options.search
    larger = [o for o in rule.options if own < o.causes and len(o.causes) == len(own) + 1]
    for option in larger if rule.held_out else ():
        nats, (name,) = options.nats(choice.chosen, option), option.causes - own
        if nats > NATS:
            fit = options.fits[option.causes]
            sized = name in equations(fit) and name not in options.vague_alone(option.causes)
            if sized and (alone := one_group(search, fit, name)):
                found.append(Doubtful(name, nats, fit, alone))
    return tuple(sorted(found, key=lambda one: -one.nats))


def averaged(search: HypothesisSearch, fit: Fitted, ruler: Ruler) -> tuple[Array, Array]:
    """Return averaged standard deviations and half-widths of 95 % intervals, (C,) each.

    A claim's own interval assumes its noise structure, and exact parameters if they were not
    calibrated. Yet evidence may hardly separate the fits, or calibration was dropped because
    predictions don't need it. So the variance is averaged, by evidence, over all fits of the same
    effects (Hoeting, Madigan, Raftery & Volinsky, Bayesian model averaging, 1999),

        var = sum_f p_f (var_f + (value_f - value)^2)

    about the claim's own value. Fits that predict held-out trials clearly worse are left out.
    """
    std, half = (np.array(a) for a in search.sure(fit))
    own, size = _values(fit.hypothesis), len(fit.hypothesis.theta)
    var, wide, whole = std[:size] ** 2, half[:size] ** 2, 1.0
    for other, weight in _rivals(search, fit, ruler):
        theirs = _values(other.hypothesis)
        rows = [theirs[key] for key in own]
        apart = other.hypothesis.theta[rows] - fit.hypothesis.theta
        s, h = (a[rows] for a in search.sure(other))
        var, wide = var + weight * (s**2 + apart**2), wide + weight * (h**2 + (NORMAL * apart) ** 2)
        whole += weight
    std[:size] = np.maximum(std[:size], np.sqrt(var / whole))
    half[:size] = np.maximum(half[:size], np.sqrt(wide / whole))
    return std, half


def _rivals(search: HypothesisSearch, fit: Fitted, ruler: Ruler) -> list[tuple[Fitted, float]]:
    """Return other fits of the same free values, and the weight of each relative to the claim."""
    names, own, found = sorted(fit.hypothesis.names), _values(fit.hypothesis), []
    for (_, _, some), other in search.fits.items():
        nats = search.score(other) - search.score(fit)
        likely = other is not fit and list(some) == names and nats > -PICKED
        if likely and set(_values(other.hypothesis)) == set(own):
            worse = ruler.held_out and ruler.gain(other, fit).clear
            found += [] if worse else [(other, math.exp(min(nats, LIKELIER_AT_MOST)))]
    return found


def _values(h: Hypothesis) -> dict[tuple[str, str], int]:
    """Return {(effect, quantity): index} of the free values."""
    return {key: i for i, key in enumerate((e.name, q.name) for e in h.effects for q in e.free)}


def plain(search: HypothesisSearch, fit: Fitted) -> Fitted:
    """Return the same hypothesis under white noise."""
    h = fit.hypothesis
    if fit.noise.structure == Structure():
        return fit
    known = search.fits.get((Structure(), h.spread, tuple(sorted(h.names))))
    noise = fit.noise.allowing(Structure(), search.data.dt)
    found = [known] if known else search.refined([(h, noise, fit.track)], TO_THE_TOP)
    return found[0] if found else fit
