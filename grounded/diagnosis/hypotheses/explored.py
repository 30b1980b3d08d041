"""The hypotheses fitted so far, their evidence, and the best of them.

    evidence(h) = b log p(y | h) - sum of the prices of its effects - price of its noise structure

b is the tempering factor, the same for all hypotheses: 1 if the likeliest of them leaves white
innovations, less if they are correlated (`grounded.filter.tempering`). The price of an effect is a
BIC penalty for its free values plus a penalty for the number of alternatives searched,

    price = k/2 ln N + ln(places looked at) + ln(targets of the family)

with k free values and N time steps. The second term applies to thresholds, frequencies and places
that were scanned on a grid; the third to families that could have been blamed at many targets. A
parameter of the model pays by its prior (standard deviation a fifth of its size) instead. A
negative friction, which reduces the model's own, pays by the same prior in addition. Effects that
cancel are rejected, as are implausible sizes: a gain that more than doubles in a trial, or a log
twice too large (`Quantity.absurd`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import combinations

import numpy as np

from grounded.diagnosis.error_report import TIMES
from grounded.diagnosis.levels import NATS, SURE
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.intervals import standard_deviations
from grounded.diagnosis.likelihood.noise import Structure
from grounded.diagnosis.likelihood.polish import APART
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects import Effect, InputFamily, MediumFamily, ParamFamily, RateFamily
from grounded.effects.wrap import ADOPTED_SPREAD
from grounded.filter.tempering import Tempering, tempering
from grounded.frozen import Array, median, white_noise


class FittedHypotheses:
    """The best fit for each noise structure, prior width of the parameters, and set of effects."""

    def __init__(self, data: Data, candidates: Sequence[Effect]) -> None:
        self.data, self.predictor = data, Predictor(data)
        self.candidates = tuple(candidates)
        self.N = max(data.steps, 2)
        self._cancelling: dict[object, bool] = {}
        self._sure: dict[tuple[int, float, bool], tuple[Fitted, tuple[Array, Array]]] = {}
        self.tempering = Tempering()
        self._prices: dict[tuple[object, ...], float] = {}
        self.fits: dict[tuple[Structure, float, tuple[str, ...]], Fitted] = {}
        families = [e.family.name for e in candidates]
        self.crowd = {e.name: families.count(e.family.name) for e in candidates}

    def price(self, effect: Effect, values: Mapping[str, float]) -> float:
        """Return the price of an effect at given values [nats]."""
        key = (effect.name, len(effect.free), *sorted(values.items()))
        if key not in self._prices:
            targets = self.crowd.get(effect.name, 1)
            self._prices[key] = price(self.data, effect, values, targets)
        return self._prices[key]

    def score(self, fit: Fitted) -> float:
        """Return the evidence of a fit [nats], up to a constant of the data."""
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
        """Return the price of all effects of a hypothesis [nats]."""
        return sum(self.price(e, v) for e, v in h.pairs)

    def cancelling(self, h: Hypothesis) -> bool:
        """Check whether effects of a hypothesis nearly cancel, so that none can be claimed."""
        key = tuple(zip(h.names, (tuple(v.values()) for v in h.values), strict=True))
        if key not in self._cancelling:
            self._cancelling[key] = cancelling(self.predictor, h)
        return self._cancelling[key]

    def keep(self, fits: Sequence[Fitted]) -> None:
        """Store fits, the best of each hypothesis under each noise structure; update tempering."""
        before = max((fit.evidence for fit in self.fits.values()), default=-math.inf)
        likeliest = max(fits, key=lambda fit: fit.evidence, default=None)
        if likeliest is not None and likeliest.evidence > before:
            self.tempering = tempering(likeliest.white, self.data.seen[1:])
        for fit in fits:
            h = fit.hypothesis
            key = (fit.noise.structure, h.spread, tuple(sorted(h.names)))
            known = self.fits.get(key)
            if known is None or self.score(fit) > self.score(known) - APART * (
                fit.fine and not known.fine
            ):
                self.fits[key] = fit

    def latest(self, fit: Fitted) -> Fitted:
        """Return the best fit of the same hypothesis under the same noise structure."""
        h = fit.hypothesis
        found = self.fits.get((fit.noise.structure, h.spread, tuple(sorted(h.names))), fit)
        return found if found.fine or self.score(found) > self.score(fit) else fit

    def best_null(self) -> Fitted:
        """Return the likeliest fit without effects."""
        return max((f for f in self.fits.values() if not f.hypothesis.effects), key=self.score)

    def exact_null(self) -> Fitted:
        """Return the likeliest fit without effects and with exact parameters."""
        bare = (f for (_, spread, names), f in self.fits.items() if not names and spread == 0)
        return max(bare, key=self.score)

    def sure(self, fit: Fitted, *, thresholds: bool = False) -> tuple[Array, Array]:
        """Return each unknown's standard deviation and half-width of its 95 % interval, (C,).

        thresholds: see `standard_deviations`; of parameters, so effects' values need none.
        """
        key = id(fit), self.tempering.factor, thresholds
        if key not in self._sure:
            found = standard_deviations(
                self.predictor, fit, self.data.folds, key[1], thresholds_too=thresholds
            )
            self._sure[key] = fit, found
        return self._sure[key][1]

    def calibrates(self) -> bool:
        """Check whether calibrating the parameters explains the data better than noise alone."""
        best = self.best_null()
        spread = best.hypothesis.spread
        return spread > 0 and self.score(best) > self.score(self.exact_null()) + NATS

    def of_size(self, count: int, *, exact: bool = False) -> list[Fitted]:
        """Return the best fit of each set of `count` effects (with exact parameters), in order."""
        best: dict[tuple[str, ...], Fitted] = {}
        for (_, spread, names), fit in self.fits.items():
            if len(names) == count and not (exact and spread > 0):
                best[names] = max(best.get(names, fit), fit, key=self.score)
        return sorted(best.values(), key=lambda f: -self.score(f))

    def chosen(self, most: int) -> Fitted:
        """Return the hypothesis to claim: each further effect must gain NATS nats."""
        chosen = self.best_null()
        for size in range(1, most + 1):
            for fit in self.of_size(size)[:1]:
                if self.score(fit) > self.score(chosen) + NATS:
                    chosen = fit
        if not chosen.hypothesis.effects and self.calibrates():
            # a single parameter is a calibration, too: it need only beat the shift of all of them
            single = [f for f in self.of_size(1) if parametric(f)]
            chosen = max([chosen, *single[:1]], key=self.score)
        return chosen


def sizeless(h: Hypothesis, std: Array) -> list[str]:
    """Return the effects of which no coefficient is known to differ from zero.

    Of effects without coefficients, their times or thresholds are asked.

    Args:
        h: the effects with their values.
        std: standard deviations of its free values, (C,) or more.
    """
    return [
        name
        for name, own in zip(h.names, h.sizes, strict=True)
        if own and (np.abs(h.theta[own]) < SURE * std[own]).all()
    ]


def parametric(fit: Fitted) -> bool:
    """Check whether all effects of a fit are parameters of the model."""
    effects = fit.hypothesis.effects
    return bool(effects) and all(isinstance(e.family, ParamFamily) for e in effects)


ACTS = RateFamily | InputFamily | MediumFamily  # what may cancel
PARAM_PRIOR = 0.2  # prior standard deviation of a blamed parameter, relative to its size
BRIEF = 0.1  # of a control step: shorter delays and lags may be errors of the time stamps
LEFT = 0.25  # effects cancel if together they do less than this fraction of what each does alone
WINDOW, OFTEN, TOO_SLOW = 0.25, 0.9, 0.5  # [s], quantile of changes, share of it: see _seen_rate
NOISE_CHANGES = 1.645  # the same quantile of |x| of a standard normal x


def price(data: Data, effect: Effect, values: Mapping[str, float], targets: int = 1) -> float:
    """Return the price of an effect, subtracted from its gain in log-likelihood [nats].

    Args:
        data: the trials, of which steps and dt count.
        effect: the effect.
        values: its values, which the price may depend on.
        targets: the number of targets at which its family could have been blamed.

    Returns:
        The price; infinite for a value that can't be claimed.
    """
    if isinstance(effect.family, ParamFamily):
        return math.log(targets) + _of_parameter(effect, values, data.steps)
    if effect.known:
        return _of_change(effect, values, data.steps)
    if values.get(TIMES.get(effect.family.name, ""), math.inf) < BRIEF * data.dt:
        return math.inf
    # a scanned value at its upper end: the data ask for more than was scanned
    each = ((q, values.get(q.name, 0.0)) for q in effect.free)
    if any(abs(v) > q.absurd or (q.grid and v >= q.high) for q, v in each):
        return math.inf
    cost = 0.5 * len(effect.free) * math.log(max(data.steps, 2)) + effect.family.vague
    cost += _of_less_friction(effect, values)
    return cost + math.log(effect.places) + math.log(targets)


def _seen_rate(data: Data, effect: Effect) -> float:
    """Return a rate at which the log shows the state to change: a limit can't be below it.

    With two commands exchanged a limit of 0 is likely: the model then turns the robot the wrong
    way, and is better without. The quantile of what noise alone changes is taken out: a steering
    angle with 0.045 rad of noise seems to move by 0.25 rad/s, whatever limits it.
    """
    i, steps = data.model.state_names.index(effect.site.target), max(1, round(WINDOW / data.dt))
    if len(data.y) <= steps:
        return 0.0
    moved = data.model.difference(data.y[:-steps], data.y[steps:])[..., i]
    known = np.asarray(data.valid.T > 0)[steps - 1 :] & np.isfinite(moved)
    if not known.any():
        return 0.0
    changed = float(np.quantile(np.abs(moved[known]), OFTEN))
    run = np.concatenate([np.ones_like(data.valid[:, :1]), data.valid], axis=1).T > 0
    noise = float(median(white_noise(np.where(run, data.y[..., i], np.nan))))
    of_noise = NOISE_CHANGES * math.sqrt(2) * noise
    return TOO_SLOW * math.sqrt(max(changed**2 - of_noise**2, 0.0)) / (steps * data.dt)


def _sent_rate(data: Data, effect: Effect) -> float:
    """Return the fastest change of an effect's inputs from step to step, as they were commanded."""
    which = [data.model.input_names.index(name) for name in effect.site.targets]
    sent = np.concatenate([data.held[:, None], data.commands], axis=1)[..., which]
    return float(np.nanmax(np.abs(np.diff(sent, axis=1)), initial=0.0) / data.dt)


def no_limits(data: Data, h: Hypothesis) -> list[str]:
    """Return the limits of rates in a hypothesis that the log refutes.

    No command reaches a limit of an input's rate above the largest step of that command over dt:
    167 rad/s, of a servo with a range of 0.7 rad and a dt of 20 ms. What it explains are details
    within the step. And a state can't change faster than its limit. Both may stand for something
    else while effects are sought (refused at once, the search ends elsewhere), but are no causes.
    """
    refuted = {
        "rate_limit": lambda effect, r: r > _sent_rate(data, effect),
        "slew_limit": lambda effect, r: r < _seen_rate(data, effect),
    }
    return [
        effect.name
        for effect, values in h.pairs
        if (beyond := refuted.get(effect.family.name)) and beyond(effect, values["r"])
    ]


def cancelling(predictor: Predictor, h: Hypothesis) -> bool:
    """Check whether effects change a step by less than LEFT of what each of them does alone.

    Two added rates can, or three and more effects on rates and inputs: a larger rate gain with a
    weaker input and less friction may just be a time constant that is 3 % shorter. (Two effects of
    different kinds, such as a dead zone and a gain, may well both be present.)
    """
    data, x = predictor.data, predictor.data.y[:-1]
    acting = (e for e in h.effects if not getattr(e.family, "parts", 0))
    rates = {e.name: isinstance(e.family, RateFamily) for e in acting if isinstance(e.family, ACTS)}
    units, size = data.model.states, dict[str, float]()  # common to all states of one unit
    for name, unit in units.items():
        size[unit] = max(size.get(unit, 0.0), data.scales.spread(name))
    scale = np.array([size[unit] for unit in units.values()])

    @cache
    def step(taken: frozenset[str]) -> Array:
        of = h
        for name in taken:
            of = of.minus(name)
        return predictor.next(of, x)

    def change(some: frozenset[str], left: frozenset[str]) -> float:
        moved = data.model.difference(step(some - left), step(some)) / scale
        return float(np.sqrt(np.sum(moved**2 * data.valid.T[..., None])))

    sets = (frozenset(s) for k in range(2, len(rates) + 1) for s in combinations(rates, k))
    return any(
        change(some, some) < LEFT * min(change(some, frozenset({name})) for name in some)
        for some in sets
        if len(some) > 2 or all(rates[name] for name in some)
    )


def _of_less_friction(effect: Effect, values: Mapping[str, float]) -> float:
    """Return the price of a negative friction: the prior of a parameter of the model's own."""
    if not getattr(effect.family, "brakes", False):
        return 0.0
    less = [values.get(q.name, 0.0) / q.low for q in effect.free if -math.inf < q.low < 0]
    return sum(0.5 * (max(share, 0.0) / PARAM_PRIOR) ** 2 for share in less)


def _of_parameter(effect: Effect, values: Mapping[str, float], steps: int) -> float:
    """Return the price of a blamed parameter, by a normal prior of a fifth of its size."""
    value = effect.site.model.params[effect.site.target].value
    size = PARAM_PRIOR * (abs(value) or 1.0)
    return 0.5 * (values.get("d", 0.0) / size) ** 2 + 0.25 * math.log(max(steps, 2)) + 1.0


def _of_change(effect: Effect, values: Mapping[str, float], steps: int) -> float:
    """Return the price of a change of an adopted effect, by the prior of its adopted values."""
    sizes = {q.name: ADOPTED_SPREAD * q.known for q in effect.free if q.known}
    pulls = sum(0.5 * (values.get(name, 0.0) / size) ** 2 for name, size in sizes.items())
    return pulls + 0.25 * len(effect.free) * math.log(max(steps, 2)) + 1.0
