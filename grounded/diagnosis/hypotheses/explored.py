"""Which hypotheses an attribution has fitted so far, their evidence, the best of them.

    evidence(h) = b log p(y | h) - what naming its effects costs - what the noise structure costs

with one b for all, 1 where the likeliest leaves white noise (`grounded.filter.tempering`).

What naming an effect costs, the price of its numbers, of looking for it, of where it might be:

    price = k/2 ln N + ln(places looked at) + ln(targets of the family)

k free values, N time steps. Thresholds, frequencies and places that were scanned pay for the
looking, and families that could have been blamed at many targets for the choice. A parameter of the
model pays by its prior (a fifth of its size) instead; a friction below zero, which is less of the
model's own, by the same prior beside. Effects that cancel are no finding, nor is a gain that more
than doubles in a trial or a log twice too large (`Quantity.absurd`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.hypothesis import Hypothesis, rates_of
from grounded.diagnosis.likelihood.noise import Structure
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects import Effect, InputFamily, MediumFamily, ParamFamily, RateFamily
from grounded.effects.wrap import SURE
from grounded.filter.tempering import Tempering, tempering
from grounded.frozen import Array

CLAIM = 3.0  # nats from which an effect is claimed
TIE = 3.0  # nats within which two explanations are not told apart


class FittedHypotheses:
    """Fits by noise structure, freedom of the parameters, and effects: the best of each."""

    def __init__(self, data: Data, candidates: Sequence[Effect]) -> None:
        self.data, self.predictor = data, Predictor(data)
        self.candidates = tuple(candidates)
        self.N = max(data.steps, 2)
        self._cancelling: dict[object, bool] = {}
        self.tempering = Tempering()
        self._prices: dict[tuple[object, ...], float] = {}
        self.fits: dict[tuple[Structure, float, tuple[str, ...]], Fitted] = {}
        families = [e.family.name for e in candidates]
        self.crowd = {e.name: families.count(e.family.name) for e in candidates}

    def price(self, effect: Effect, values: Mapping[str, float]) -> float:
        """What an effect pays beside its likelihood, in nats."""
        key = (effect.name, len(effect.free), *sorted(values.items()))
        if key not in self._prices:
            targets = self.crowd.get(effect.name, 1)
            self._prices[key] = price(self.predictor, effect, values, targets)
        return self._prices[key]

    def score(self, fit: Fitted) -> float:
        """Evidence of a fit in nats, up to a constant of the data."""
        h = fit.hypothesis
        if self.cancelling(h):
            return -math.inf
        paid = self.paid(h)
        extra = fit.noise.structure.numbers(self.data.model.n)
        calibration = 1.0 if h.spread > 0 else 0.0
        return (
            self.tempering.factor * fit.evidence
            - paid
            - 0.5 * extra * math.log(self.N)
            - calibration
        )

    def paid(self, h: Hypothesis) -> float:
        """What all effects of a hypothesis pay beside its likelihood [nats]."""
        return sum(self.price(e, v) for e, v in h.pairs)

    def cancelling(self, h: Hypothesis) -> bool:
        """Whether effects of a hypothesis all but cancel: none of them is a finding."""
        key = tuple(zip(h.names, (tuple(v.values()) for v in h.values), strict=True))
        if key not in self._cancelling:
            self._cancelling[key] = cancelling(self.predictor, h)
        return self._cancelling[key]

    def keep(self, fits: Sequence[Fitted]) -> None:
        """Remembers the best fit of every hypothesis under every structure."""
        before = max((fit.evidence for fit in self.fits.values()), default=-math.inf)
        likeliest = max(fits, key=lambda fit: fit.evidence, default=None)
        if likeliest is not None and likeliest.evidence > before:
            self.tempering = tempering(likeliest.white, self.data.seen[1:])
        for fit in fits:
            h = fit.hypothesis
            key = (fit.noise.structure, h.spread, tuple(sorted(h.names)))
            if key not in self.fits or self.score(fit) > self.score(self.fits[key]):
                self.fits[key] = fit

    def best_null(self) -> Fitted:
        """The likeliest fit without effects."""
        return max((f for f in self.fits.values() if not f.hypothesis.effects), key=self.score)

    def exact_null(self) -> Fitted:
        """The likeliest fit without effects and with the parameters as they are."""
        bare = (f for (_, spread, names), f in self.fits.items() if not names and spread == 0)
        return max(bare, key=self.score)

    def calibrates(self) -> bool:
        """Whether calibrating the model's parameters explains more than noise does."""
        best = self.best_null()
        spread = best.hypothesis.spread
        return spread > 0 and self.score(best) > self.score(self.exact_null()) + CLAIM

    def of_size(self, count: int) -> list[Fitted]:
        """All fits with that many effects, best first, one a set of effects."""
        best: dict[tuple[str, ...], Fitted] = {}
        for (_, _, names), fit in self.fits.items():
            if len(names) == count and (
                names not in best or self.score(fit) > self.score(best[names])
            ):
                best[names] = fit
        return sorted(best.values(), key=lambda f: -self.score(f))

    def chosen(self, most: int) -> Fitted:
        """The hypothesis that would be claimed: every effect more has to pay for itself."""
        chosen = self.best_null()
        for size in range(1, most + 1):
            for fit in self.of_size(size)[:1]:
                if self.score(fit) > self.score(chosen) + CLAIM:
                    chosen = fit
        if not chosen.hypothesis.effects and self.calibrates():
            # one parameter is a calibration too: it need only be likelier than the shift of all
            single = [f for f in self.of_size(1) if parametric(f)]
            chosen = max([chosen, *single[:1]], key=self.score)
        return chosen


def parametric(fit: Fitted) -> bool:
    """Whether all that a fit blames is the model's own parameters."""
    effects = fit.hypothesis.effects
    return bool(effects) and all(isinstance(e.family, ParamFamily) for e in effects)


PARAM_PRIOR = 0.2  # prior relative error of one parameter that is blamed
BRIEF = 0.1  # of a control step: shorter delays and lags are a matter of time stamps
TIMES = {"delay": "d", "sensor_delay": "d", "first_order_lag": "tau", "sensor_lag": "tau"}
LEFT = 0.25  # of what effects do alone, from which together they are more than counterparts
SAME = 0.05  # part of a dead zone's power that a mere offset may lack and still be the same


def price(
    predictor: Predictor, effect: Effect, values: Mapping[str, float], targets: int = 1
) -> float:
    """What an effect pays beside its likelihood [nats].

    Args:
        predictor: the data.
        effect: which.
        values: its values, for those whose price depends on them.
        targets: at how many targets its family could have been blamed.
    """
    data = predictor.data
    if isinstance(effect.family, ParamFamily):
        return math.log(targets) + _of_parameter(effect, values, data.steps)
    if effect.known:
        return _of_change(effect, values, data.steps)
    if values.get(TIMES.get(effect.family.name, ""), math.inf) < BRIEF * data.dt:
        return math.inf
    if any(abs(values.get(q.name, 0.0)) > q.absurd for q in effect.free):
        return math.inf
    numbers = len(effect.free) + sum(q.tuned for q in effect.quantities)
    cost = 0.5 * numbers * math.log(max(data.steps, 2)) + effect.family.vague
    cost += _of_less_friction(effect, values)
    if not _mere_offset(predictor, effect, values):
        cost += math.log(effect.places)
    return cost + math.log(targets)


def cancelling(predictor: Predictor, h: Hypothesis) -> bool:
    """Whether effects leave little of one another: two added rates, or three effects and more."""
    size = sizes(predictor)
    return _two_rates_cancel(predictor, h, size) or _several_cancel(predictor, h, size)


def sizes(predictor: Predictor) -> Array:
    """What changes of each state are measured in, (n,): those of one unit share a scale."""
    units, scales = predictor.data.model.states, predictor.data.scales
    return np.array(
        [max(scales.spread(n) for n in units if units[n] == unit) for unit in units.values()]
    )


def _two_rates_cancel(predictor: Predictor, h: Hypothesis, size: Array) -> bool:
    """Whether the sum of two added rates is less than LEFT of the larger; `size` (n,) of states."""
    rates, data = rates_of(h), predictor.data
    if len(rates) < 2:
        return False
    x, u = data.y[:-1], predictor.inputs(h)
    needed = any(effect.family.needs_own for effect, _ in rates)
    own = predictor.named((predictor.moved(h, x, u) - x) / data.dt) if needed else {}
    by = [predictor.added_rate([one], x, u, data.time, own) / size for one in rates]
    lengths = [float(np.sqrt(np.sum(one**2))) for one in by]
    return any(
        np.sqrt(np.sum((by[i] + by[j]) ** 2)) < LEFT * max(lengths[i], lengths[j])
        for i in range(len(by))
        for j in range(i)
    )


def _several_cancel(predictor: Predictor, h: Hypothesis, size: Array) -> bool:
    """Whether three effects or more change a step by less than LEFT of what each does alone.

    Rates and what an actuator makes of a command alike: a rate that is half as fast again, of a
    weaker input, beside less friction is a time constant that is three percent shorter. (Two of
    them that differ in kind, a dead zone and a gain, may well both be there.)
    """
    data, x = predictor.data, predictor.data.y[:-1]
    kinds = RateFamily | InputFamily | MediumFamily
    known = [p for p in h.pairs if isinstance(p[0].family, kinds)]
    names = [effect.name for effect, _ in known if not getattr(effect.family, "parts", 0)]

    def step(of: Hypothesis) -> Array:
        return predictor.next(of, x)

    def without(of: Hypothesis, taken: Sequence[str]) -> Hypothesis:
        for name in taken:
            of = of.minus(name)
        return of

    for count in range(3, len(names) + 1):
        for some in combinations(names, count):
            bare = step(without(h, some))

            def change(of: Hypothesis, bare: Array = bare) -> float:
                moved = data.model.difference(step(of), bare) / size
                return float(np.sqrt(np.sum(moved**2 * data.valid.T[..., None])))

            alone = [change(without(h, [n for n in some if n != name])) for name in some]
            if change(h) < LEFT * min(alone):
                return True
    return False


def _of_less_friction(effect: Effect, values: Mapping[str, float]) -> float:
    """What a friction below zero pays: the model's own, which is less, has a parameter's prior."""
    if not getattr(effect.family, "brakes", False):
        return 0.0
    less = [values.get(q.name, 0.0) / q.low for q in effect.free if -math.inf < q.low < 0]
    return sum(0.5 * (max(share, 0.0) / PARAM_PRIOR) ** 2 for share in less)


def _of_parameter(effect: Effect, values: Mapping[str, float], steps: int) -> float:
    """A normal prior of a fifth of the parameter's size, not a free parameter's cost."""
    value = effect.site.model.params[effect.site.target].value
    size = PARAM_PRIOR * (abs(value) or 1.0)
    return 0.5 * (values.get("d", 0.0) / size) ** 2 + 0.25 * math.log(max(steps, 2)) + 1.0


def _of_change(effect: Effect, values: Mapping[str, float], steps: int) -> float:
    """The same of an effect that was adopted: as uncertain as its numbers that are parameters."""
    sizes = {q.name: SURE * q.known for q in effect.free if q.known}
    pulls = sum(0.5 * (values.get(name, 0.0) / size) ** 2 for name, size in sizes.items())
    return pulls + 0.25 * len(effect.free) * math.log(max(steps, 2)) + 1.0


def _mere_offset(predictor: Predictor, effect: Effect, values: Mapping[str, float]) -> bool:
    """Whether a dead zone acts as one offset all the time, because nothing ever rests in it.

    Then its threshold was not searched for among many: any would have been the same effect.
    """
    if effect.family.name != "dead_zone" or "c" not in values:
        return False
    data, x = predictor.data, predictor.data.y[:-1]
    model, j = data.model, data.model.input_names.index(effect.site.target)
    zone = predictor.inputs(Hypothesis().plus(effect, values))
    plain = predictor.inputs(Hypothesis())
    offset = plain.copy()
    offset[..., j] -= values["c"] * np.sign(plain[..., j].mean())
    p = predictor.params(Hypothesis())
    acts, missed = 0.0, 0.0
    after = predictor.step(x, zone, p)
    for other in (plain, offset):
        moved = model.difference(predictor.step(x, other, p), after)
        size = float((moved**2 * data.valid.T[..., None]).sum())
        acts, missed = (size, missed) if other is plain else (acts, size)
    return missed <= SAME * acts
