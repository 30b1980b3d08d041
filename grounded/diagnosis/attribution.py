"""Which effect: hypotheses compared by evidence, confirmed on trials that were left out.

    evidence(h) = log p(y | h) - k/2 ln N - ln(places looked at) - ln(targets of the family)
                  - what the noise structure costs

N time steps, k free values. The price of looking pays for thresholds, frequencies and places that
were scanned and for families that could have been blamed at many targets; a parameter of the model
pays by its prior (a fifth of its size) instead.

The search: fit the model without effects under plain noise, coloured noise, heavy tails, and with
its parameters calibrated; scan every candidate beside the likely ones of these; refine a shortlist;
scan again with the noise that the best hypothesis leaves; add a second effect where it pays, swap
and drop what another explains better.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from grounded.diagnosis.data import Data
from grounded.diagnosis.hypothesis import Hypothesis, Predictor
from grounded.diagnosis.noise import Structure, first_guess
from grounded.diagnosis.refine import Fit, clean, refine
from grounded.diagnosis.scan import Look, scan
from grounded.effects import Effect, ParamFamily

CLAIM = 5.0  # nats from which an effect is claimed
TIE = 3.0  # nats within which two explanations are not told apart
SPREADS = (0.03, 0.1)  # prior relative errors of the model's parameters when they are calibrated
PARAM_PRIOR = 0.2  # prior relative error of one parameter that is blamed
SHORTLIST = 14  # effects that are refined of a scan, and half as many parameters
TAUS = (0.05, 0.1, 0.3)  # [s] of coloured noise
LARGE = 8  # states, above which one correlation time and half the shortlist have to do


class Search:
    """The bookkeeping of one attribution."""

    def __init__(
        self,
        data: Data,
        candidates: Sequence[Effect],
        tick: Callable[[str], None] | None = None,
    ) -> None:
        self.data, self.predictor = data, Predictor(data)
        self.candidates = tuple(candidates)
        self.tick = tick or (lambda what: None)
        self.N = max(data.steps, 2)
        self.fits: dict[tuple[Structure, float, tuple[str, ...]], Fit] = {}
        families = [e.family.name for e in candidates]
        large = data.model.n > LARGE
        self.taus = [tau for tau in (TAUS[1:2] if large else TAUS) if tau > 0.7 * data.dt]
        self.most = SHORTLIST // 2 if large else SHORTLIST
        self.crowd = {e.name: families.count(e.family.name) for e in candidates}

    def price(self, effect: Effect, values: dict[str, float]) -> float:
        """What an effect pays beside its likelihood, in nats."""
        if isinstance(effect.family, ParamFamily):
            return math.log(self.crowd.get(effect.name, 1)) + self._param_price(effect, values)
        k = len(effect.free)
        cost = 0.5 * k * math.log(self.N) + math.log(effect.places) + effect.family.vague
        return cost + math.log(self.crowd.get(effect.name, 1))

    def _param_price(self, effect: Effect, values: dict[str, float]) -> float:
        """A normal prior of a fifth of the parameter's size, not a free parameter's cost."""
        value = effect.site.model.params[effect.site.target].value
        size = PARAM_PRIOR * (abs(value) or 1.0)
        return 0.5 * (values.get("d", 0.0) / size) ** 2 + 0.25 * math.log(self.N) + 1.0

    def score(self, fit: Fit) -> float:
        """Evidence of a fit in nats, up to a constant of the data."""
        h = fit.hypothesis
        paid = sum(self.price(e, dict(v)) for e, v in zip(h.effects, h.values, strict=True))
        extra = fit.noise.structure.numbers(self.data.model.n)
        calibration = 1.0 if h.spread > 0 else 0.0
        return fit.evidence - paid - 0.5 * extra * math.log(self.N) - calibration

    def keep(self, fits: Sequence[Fit]) -> None:
        """Remembers the best fit of every hypothesis under every structure."""
        for fit in fits:
            h = fit.hypothesis
            key = (fit.noise.structure, h.spread, tuple(sorted(h.names)))
            if key not in self.fits or self.score(fit) > self.score(self.fits[key]):
                self.fits[key] = fit

    def refined(self, starts: Sequence[Fit | tuple], iterations: int = 6) -> list[Fit]:  # type: ignore[type-arg]
        """Refines, remembers, returns."""
        fits = refine(
            self.predictor, starts, iterations=iterations, tick=lambda: self.tick("refine")
        )
        self.keep(fits)
        return fits

    # -- without effects ------------------------------------------------------------------------

    def nulls(self) -> Fit:
        """The model alone under every noise structure, and with its parameters calibrated."""
        data = self.data
        h, track = Hypothesis(), data.y.copy()
        residual = data.model.difference(self.predictor.next(h, track[:-1]), track[1:])
        scale = np.array([data.scales.spread(n) for n in data.model.state_names])
        noise = first_guess(residual, data.seen, scale)
        (plain,) = self.refined([(h, noise, track)], iterations=20)
        self.structures(plain)
        self.calibrated(plain)
        if self.best_null() is not plain:
            self.calibrated(self.best_null())
        return self.best_null()

    def fair(self, best: Fit) -> None:
        """The model alone, starting from the noise and the shifts that the best hypothesis has.

        What is compared with must have climbed as high as it can, or a better noise passes for an
        effect.
        """
        h = best.hypothesis
        bare = Hypothesis(shift=h.shift, spread=h.spread)
        starts = [(bare, best.noise, best.track)]
        if best.noise.structure.tau is None:
            starts += [
                (bare, best.noise.allowing(Structure(tau), self.data.dt), best.track)
                for tau in self.taus
            ]
            self.refined(starts[1:], iterations=8)
        self.refined(starts[:1], iterations=10)

    def structures(self, fit: Fit) -> list[Fit]:
        """A hypothesis with coloured noise of several correlation times (if it had none)."""
        if fit.noise.structure.tau is not None:
            return []
        starts = [
            (fit.hypothesis, fit.noise.allowing(Structure(tau), self.data.dt), fit.track)
            for tau in self.taus
        ]
        return self.refined(starts, iterations=8)

    def calibrated(self, fit: Fit) -> list[Fit]:
        """The same hypothesis with the model's parameters free to move a little, or more."""
        shift = np.zeros(self.data.model.system.k)
        if fit.hypothesis.spread > 0 or not len(shift):
            return []
        return self.refined(
            [
                (replace(fit.hypothesis, spread=spread, shift=shift), fit.noise, fit.track)
                for spread in SPREADS
            ],
            iterations=9,
        )

    def best_null(self) -> Fit:
        """The likeliest fit without effects."""
        return max((f for f in self.fits.values() if not f.hypothesis.effects), key=self.score)

    def exact_null(self) -> Fit:
        """The likeliest fit without effects and with the parameters as they are."""
        bare = (f for (_, spread, names), f in self.fits.items() if not names and spread == 0)
        return max(bare, key=self.score)

    def calibrates(self) -> bool:
        """Whether calibrating the model's parameters explains more than noise does."""
        best = self.best_null()
        spread = best.hypothesis.spread
        return spread > 0 and self.score(best) > self.score(self.exact_null()) + CLAIM

    def with_weights(self, clean_fit: Fit) -> Search:
        """A new search on the same data with a clean fit's outlier weights in all noise."""
        other = Search(self.data, self.candidates, self.tick)
        weights = clean_fit.noise
        starts = []
        for fit in [*self.of_size(0), *self.of_size(1)[:SHORTLIST], clean_fit]:
            noise = replace(
                weights if fit.noise.structure == weights.structure else fit.noise,
                weight_w=weights.weight_w,
                weight_v=weights.weight_v,
                last=None,
            )
            starts.append((fit.hypothesis, noise, fit.track))
        for structure in {s[1].structure for s in starts}:
            other.refined([s for s in starts if s[1].structure == structure], 8)
        plain = [f for f in other.fits.values() if not f.hypothesis.effects]
        if not any(f.noise.structure == Structure() and not f.hypothesis.spread for f in plain):
            noise = replace(weights, structure=Structure(), last=None)
            other.refined([(Hypothesis(), noise, clean_fit.track)], 12)
        return other

    # -- one effect more --------------------------------------------------------------------------

    def shortlist(self, fit: Fit, count: int) -> list[Look]:
        """The candidates that would add most to a fit, after their price."""
        taken = set(fit.hypothesis.names)
        free = [
            e
            for e in self.candidates
            if e.name not in taken
            and not (isinstance(e.family, ParamFamily) and fit.hypothesis.spread > 0)
        ]
        self.tick("scan")
        looks = scan(self.predictor, fit, free)
        worth = [(look.gain - self.price(look.effect, look.values), look) for look in looks]
        worth = [(w, look) for w, look in worth if np.isfinite(w) and look.values]
        worth.sort(key=lambda pair: -pair[0])
        params = [look for _, look in worth if isinstance(look.effect.family, ParamFamily)]
        others = [look for _, look in worth if not isinstance(look.effect.family, ParamFamily)]
        return others[:count] + params[: count // 2]

    def extended(self, fit: Fit, count: int = 0, iterations: int = 7) -> list[Fit]:
        """The fit with each shortlisted effect added, refined."""
        starts: list[Fit | tuple] = [fit]  # type: ignore[type-arg]
        for look in self.shortlist(fit, count or self.most):
            h = fit.hypothesis
            starts.append((h.plus(look.effect, look.values), fit.noise, fit.track))
            if look.second is not None and self.far(look):
                starts.append((h.plus(look.effect, look.second), fit.noise, fit.track))
        return self.refined(starts, iterations)[1:]

    @staticmethod
    def far(look: Look) -> bool:
        """Whether the second grid point is not the first one's neighbour."""
        assert look.second is not None
        for q in look.effect.free:
            if q.grid:
                grid = list(q.grid)
                i, j = (
                    int(np.argmin(np.abs(np.array(grid) - v[q.name])))
                    for v in (look.values, look.second)
                )
                if abs(i - j) > 1:
                    return True
        return False

    def of_size(self, count: int) -> list[Fit]:
        """All fits with that many effects, best first, one a set of effects."""
        best: dict[tuple[str, ...], Fit] = {}
        for (_, _, names), fit in self.fits.items():
            if len(names) == count and (
                names not in best or self.score(fit) > self.score(best[names])
            ):
                best[names] = fit
        return sorted(best.values(), key=lambda f: -self.score(f))


def attribute(
    data: Data,
    candidates: Sequence[Effect],
    *,
    max_effects: int = 3,
    tick: Callable[[str], None] | None = None,
) -> tuple[Search, Fit]:
    """Searches for the effects that make the gap; returns the search and its best fit.

    Args:
        data: from `prepare`.
        candidates: the effects that may be blamed.
        max_effects: at most so many at once.
        tick: called with what is being done, for a progress display.
    """
    with np.errstate(all="ignore"):  # a hypothesis that diverges scores minus infinity
        search, best = _searched(Search(data, candidates, tick))
        _grow(search, best, max_effects)
    chosen = search.best_null()
    for size in range(1, max_effects + 1):
        for fit in search.of_size(size)[:1]:
            if search.score(fit) > search.score(chosen) + CLAIM:
                chosen = fit
    if not chosen.hypothesis.effects and search.calibrates():
        # one parameter is a calibration too: it need only be likelier than the shift of all
        single = [f for f in search.of_size(1) if parametric(f)]
        chosen = max([chosen, *single[:1]], key=search.score)
    return search, chosen


def parametric(fit: Fit) -> bool:
    """Whether all that a fit blames is the model's own parameters."""
    effects = fit.hypothesis.effects
    return bool(effects) and all(isinstance(e.family, ParamFamily) for e in effects)


def _searched(search: Search) -> tuple[Search, Fit]:
    """The best single hypothesis; with outliers in the data, the best with their weights."""
    search.nulls()
    best = _explore(search)
    if outliers(best):
        search = search.with_weights(clean(search.predictor, best))
        best = _explore(search)
    return search, best


def _explore(search: Search) -> Fit:
    """The best hypothesis of one effect, or without when there is none to try."""
    null = search.best_null()
    plain = search.fits.get((Structure(), 0.0, ()), null)
    for context in [null] if plain is null else [null, plain]:
        search.extended(context)
    singles = search.of_size(1)
    if not singles:
        return null
    for kind in {fit.noise.structure for fit in singles[:SHORTLIST]}:
        # a large effect has a long way from its first look
        search.refined([f for f in singles[:SHORTLIST] if f.noise.structure == kind], 8)
    best = search.of_size(1)[0]
    for _ in range(2):  # with the noise that the best one leaves, others may look better
        search.extended(_without_last(best))
        search.structures(best)
        search.calibrated(best)
        again = search.of_size(1)[0]
        same = again.hypothesis.names == best.hypothesis.names
        best = again
        if same:
            break
    search.fair(best)
    return max([best, search.best_null()], key=search.score)


def outliers(fit: Fit) -> bool:
    """Whether whitened innovations beyond 4 are far more frequent than a normal law has them."""
    count = float((np.abs(fit.white) > 4.0).sum())
    expected = 6.3e-5 * fit.white.size
    return count > 4 + 3 * expected


def _without_last(fit: Fit) -> Fit:
    """The fit's noise and track with its last effect taken out of the hypothesis."""
    h = fit.hypothesis.minus(fit.hypothesis.names[-1])
    return _bare(fit, h)


def _bare(fit: Fit, h: Hypothesis) -> Fit:
    """A fit that pretends another hypothesis at the same noise and track (to scan from)."""
    k = len(h.theta)
    rest = fit.gram.shape[-1] - len(fit.hypothesis.theta)
    B = len(fit.rss)
    return replace(
        fit, hypothesis=h, gram=np.zeros((B, k + rest, k + rest)), score=np.zeros((B, k + rest))
    )


def _grow(search: Search, best: Fit, most: int) -> None:
    """Second and further effects: add, then swap each for what goes better with the others."""
    size = len(best.hypothesis.effects)
    while 1 <= size < most:
        for start in search.of_size(size)[: 3 if size == 1 else 1]:
            if search.score(start) > search.score(best) - 25:
                search.extended(start, 8)
        larger = search.of_size(size + 1)
        if not larger or search.score(larger[0]) < search.score(best) + CLAIM:
            return
        best = larger[0]
        for name in best.hypothesis.names:  # what goes better with the others?
            search.extended(_bare(best, best.hypothesis.minus(name)), 6)
        best = search.of_size(size + 1)[0]
        size += 1
