"""The steps of the search: which hypotheses are fitted, from which start and under which noise.

`HypothesisSearch` adds fits to those done so far (`explored`); `attribution` says in which order,
and `tuning` sets the constants of effects, which are not parameters of the fits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Self

import numpy as np

from grounded.checks import refused
from grounded.diagnosis.hypotheses.explored import FittedHypotheses, parametric, sizeless
from grounded.diagnosis.hypotheses.scan import Look, scan_candidates
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.delays import delayed
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.noise import NoiseModel, Structure, noise_guess
from grounded.diagnosis.likelihood.polish import polished
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.refine import refine
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.effects import (
    Effect,
    ParamFamily,
    SensorDelayFamily,
    acting_order,
    one_friction,
)
from grounded.effects.drive import motion_of
from grounded.errors import GroundedError, NextCommand
from grounded.frozen import Array

SPREADS = (0.1, 0.3)  # prior widths of calibrated parameters, as fractions of the user's
CRUDE = 1.0  # the same once a parameter has moved beyond: its full prior
SHORTLIST = 14  # effects of a scan that are refined, and half as many parameters
TAUS = (0.05, 0.1, 0.3)  # correlation times of coloured noise [s]
STEPS_TAUS = (1.0, 2.0, 6.0)  # the same in steps, where a step is longer than all of TAUS
FREED_BESIDE = 4  # effects that are fitted with the parameters freed
# initial noise of a delayed sensor, as a fraction of its one-step residual's variance
LATE_NOISE = 0.45
SOME_DELAYS = 3  # grid values at which the delay of one sensor is tried
LATE = slice(1, 4, 2)  # grid values from which the common delay of two states starts
LARGE_GAIN = 50.0  # nats above which a hypothesis is also fitted from a start of its own
TO_THE_TOP = 25  # most iterations of fits that decide; most converge earlier
STATES_LARGE = 8  # states; above, or for a simulator, one correlation time and half the shortlist


Start = tuple[Hypothesis, NoiseModel, Array]


class HypothesisSearch(FittedHypotheses):
    """The fits of one attribution (`FittedHypotheses`), and methods that add more of them.

    `joints`: {velocity: plain dry friction of its joint}, candidates or not (`plainest`).
    """

    def __init__(
        self,
        data: Data,
        candidates: Sequence[Effect],
        tick: Callable[[str], None] | None = None,
        joints: Sequence[Effect] = (),
    ) -> None:
        super().__init__(data, candidates)
        self.joints = {motion_of(effect): effect for effect in joints}
        self.crowd |= dict.fromkeys((effect.name for effect in joints), len(joints))
        self.tick = tick or (lambda what: None)
        large = data.model.n > STATES_LARGE or simulated(data.model)
        taus = TAUS[1:2] if large else TAUS
        self.taus = [tau for tau in taus if tau > 0.7 * data.dt]
        self.taus = self.taus or [k * data.dt for k in STEPS_TAUS[: len(taus)]]
        self.most = SHORTLIST // 2 if large else SHORTLIST
        self.beside = FREED_BESIDE // 2 if large else FREED_BESIDE
        # the scan can't find them, since its noise and track belong to a log without delay
        late = [e for e in candidates if isinstance(e.family, SensorDelayFamily)]
        self.together = [e for e in late if len(e.site.targets) > 1]
        self.alone = [e for e in late if len(e.site.targets) == 1]

    def refined(
        self,
        starts: Sequence[Fitted | tuple],  # type: ignore[type-arg]
        iterations: int = 6,
        *,
        rivals: bool = False,
        bar: float = -math.inf,
    ) -> list[Fitted]:
        """Refine hypotheses and keep the fits; of rivals, those far behind stop early.

        bar: the score of the best rival that is known already.
        """
        fits = refine(
            self.predictor,
            starts,
            iterations=iterations,
            tick=self._ticks,
            worth=self.score if rivals else None,
            bar=bar,
        )
        self.keep(fits)
        return fits

    def settled(self, fits: Sequence[Fitted]) -> None:
        """Converge fits that decide, see `polished`."""
        self.keep(polished(self.predictor, fits, iterations=TO_THE_TOP, tick=self._ticks))

    def _ticks(self) -> None:
        self.tick("refine")

    # -- without effects ------------------------------------------------------------------------

    def nulls(self, alone: Sequence[Fitted] = ()) -> Fitted:
        """Fit the model alone under every noise structure and with calibrated parameters."""
        found = self.refined(alone or [self.fresh(Hypothesis())], TO_THE_TOP)
        if not found:
            raise undefined(self.predictor)
        (plain,) = found
        self.structures(plain)
        self.calibrated(plain)
        if self.best_null() is not plain:
            self.calibrated(self.best_null())
        return self.best_null()

    def fresh(self, h: Hypothesis) -> Start:
        """Return a start from the log as the track, with the noise of the residuals about it."""
        data, track = self.data, self.predictor.remembered(h, self.data.y.copy())
        predicted = self.predictor.next(h, track[:-1])
        residual = data.model.difference(predicted, track[1:])
        scale = np.array([data.scales.spread(n) for n in data.model.state_names])
        scale[list(data.hidden)] = 0.0  # nothing disturbs a memory
        noise = noise_guess(residual, data.seen, scale).behind(data.now)
        if late := [data.model.state_names.index(name) for name in delayed(h.effects)]:
            log_r = noise.log_r.copy()  # the delay hides it; a fit decreases it from above
            log_r[late] = np.logaddexp(noise.log_q, log_r + math.log(2))[late] + math.log(
                LATE_NOISE
            )
            noise = replace(noise, log_r=log_r)
        return h, noise, track

    def anew(self, fit: Fitted, effect: Effect, values: Mapping[str, float]) -> Start:
        """Return a `fresh` start of a fit's hypothesis with one more effect."""
        return self.fresh_as(fit, fit.hypothesis.plus(effect, values))

    def fresh_as(self, fit: Fitted, h: Hypothesis) -> Start:
        """Return a `fresh` start of a hypothesis, with the noise structure and weights of a fit."""
        h, noise, track = self.fresh(h)
        noise = noise.allowing(fit.noise.structure, self.data.dt)
        weight_w, weight_v = fit.noise.weight_w, fit.noise.weight_v
        return h, replace(noise, weight_w=weight_w, weight_v=weight_v), track

    def coloured(
        self, h: Hypothesis, noise: NoiseModel, track: Array, *, iterations: int
    ) -> list[Fitted]:
        """Fit a hypothesis from a start under coloured noise of the other correlation times."""
        others = [Structure(tau) for tau in self.taus if tau != noise.structure.tau]
        starts = [(h, noise.allowing(other, self.data.dt), track) for other in others]
        return self.refined(starts, iterations)

    def structures(self, fit: Fitted) -> None:
        """Fit a hypothesis with coloured noise of several correlation times (if it has none)."""
        if fit.noise.structure.tau is None:
            most = 8 if fit.hypothesis.effects else TO_THE_TOP
            self.coloured(fit.hypothesis, fit.noise, fit.track, iterations=most)

    def calibrated(self, fit: Fitted) -> list[Fitted]:
        """Fit a hypothesis with the model's parameters free within fractions of their priors.

        If a parameter moves by more than that, fit it with the full prior, too.
        """
        shift = np.zeros(self.data.model.system.k)
        if fit.hypothesis.spread > 0 or not self.data.model.spreads.any():
            return []
        starts = [
            (replace(fit.hypothesis, spread=w, shift=shift), fit.noise, fit.track) for w in SPREADS
        ]
        found = self.refined(starts, iterations=14)
        if found and self.far(found[-1]):
            crude = replace(found[-1].hypothesis, spread=CRUDE)
            found += self.refined([(crude, found[-1].noise, found[-1].track)], iterations=10)
        return found

    def exact(self, fit: Fitted) -> list[Fitted]:
        """Return the likeliest fit with exact parameters of the effects of a calibrated fit.

        What calibration explains with all parameters may be one of them, or one more effect.
        """
        own, most = {*fit.hypothesis.names}, len(fit.hypothesis.names)
        return [f for f in self.of_size(most, exact=True) if {*f.hypothesis.names} == own]

    def shrunk(self, fits: Sequence[Fitted]) -> None:
        """Fit sets without an effect of no size again, if they are less likely than with it.

        They stopped beside their maximum, as fits at kinks may, and start from the larger set's.
        """
        for fit in fits:
            for name in sizeless(fit.hypothesis, self.sure(fit)[0]):
                start = fit.hypothesis.minus(name), fit.noise, fit.track
                key = fit.noise.structure, fit.hypothesis.spread, tuple(sorted(start[0].names))
                if key not in self.fits or self.score(self.fits[key]) < self.score(fit):
                    self.refined([start], TO_THE_TOP)

    def far(self, fit: Fitted) -> bool:
        """Check whether a parameter has moved by more than its prior standard deviation."""
        h, unit = fit.hypothesis, self.data.model.spreads
        assert h.shift is not None
        return bool((np.abs(h.shift) > h.spread * unit).any())

    def beside_parameters(self) -> None:
        """Refit the likeliest effects with the parameters free.

        They start from fits with exact parameters, in which effects have their full size: beside
        parameters that absorbed it, an effect would not grow. Either can hide the other.
        """
        exact = [
            f
            for (structure, spread, names), f in self.fits.items()
            if len(names) == 1 and spread == 0 and structure.tau is None and not parametric(f)
        ]
        exact.sort(key=lambda f: -self.score(f))
        count = self.beside if self.calibrates() else self.beside // 2
        for fit in self.refined(exact[:count], 12):
            self.calibrated(fit)

    def like(self, data: Data | None = None, but: str = "") -> Self:
        """Return a search without fits, on other data or without one effect."""
        kept, joints = (
            [effect for effect in some if effect.name != but]
            for some in (self.candidates, self.joints.values())
        )
        return type(self)(data or self.data, kept, self.tick, joints)

    def with_weights(self, clean_fit: Fitted) -> HypothesisSearch:
        """Return a new search on the same data, all with the outlier weights of `clean_fit`."""
        other = self.like()
        weights = clean_fit.noise
        starts = []
        for fit in [*self.of_size(0), *self.of_size(1)[:SHORTLIST], clean_fit]:
            noise = replace(
                weights if fit.noise.structure == weights.structure else fit.noise,
                weight_w=weights.weight_w,
                weight_v=weights.weight_v,
            )
            starts.append((fit.hypothesis, noise, fit.track))
        other.refined(starts, 8)
        plain = [f for f in other.fits.values() if not f.hypothesis.effects]
        if not any(f.noise.structure == Structure() and not f.hypothesis.spread for f in plain):
            noise = replace(weights, structure=Structure())
            other.refined([(Hypothesis(), noise, clean_fit.track)], 12)
        return other

    def shortlist(self, fit: Fitted, count: int) -> list[Look]:
        """Return the candidates that would gain most beside a fit, less their price."""
        taken = set(fit.hypothesis.names)
        free = [
            e
            for e in self.candidates
            if e.name not in taken
            and not any(one_friction(e, known) for known in fit.hypothesis.effects)
            and not delayed([e]) & delayed(fit.hypothesis.effects)
            and not (isinstance(e.family, ParamFamily) and fit.hypothesis.spread > 0)
        ]
        self.tick("scan")
        looks = scan_candidates(self.predictor, fit, free)
        worth = [(look.gain - self.price(look.effect, look.values), look) for look in looks]
        worth = [(w, look) for w, look in worth if np.isfinite(w) and look.values]
        worth.sort(key=lambda pair: -pair[0])
        params = [look for _, look in worth if isinstance(look.effect.family, ParamFamily)]
        others = [look for _, look in worth if not isinstance(look.effect.family, ParamFamily)]
        return others[:count] + params[: count // 2]

    def extended(
        self, fit: Fitted, count: int = 0, iterations: int = 7, *, late: bool = True
    ) -> list[Fitted]:
        """Refine the fit with each shortlisted effect added.

        Args:
            fit: what is extended.
            count: length of the shortlist; 0: the usual one.
            iterations: most iterations of each fit.
            late: include common delays of two states.
        """
        starts = self.one_more(fit, count or self.most, late=late)
        h, structure, size = fit.hypothesis, fit.noise.structure, len(fit.hypothesis.names) + 1
        known = [
            self.score(other)
            for (noise, spread, names), other in self.fits.items()
            if (noise, spread, len(names)) == (structure, h.spread, size)
        ]
        bar = max(known, default=-math.inf)
        return self.refined([fit, *starts], iterations, rivals=True, bar=bar)[1:]

    def one_more(self, fit: Fitted, count: int, *, late: bool = True) -> list[Start]:
        """Return the starts of a fit with each shortlisted effect added."""
        starts: list[Start] = []
        for look in self.shortlist(fit, count):
            more = [fit.hypothesis.plus(look.effect, v) for v in (look.values, *look.others)]
            more += first(self.predictor, more[0])
            starts += [(h, fit.noise, fit.track) for h in more]
        for effect in self.together if late else ():
            if not delayed([effect]) & delayed(fit.hypothesis.effects):
                starts += [self.anew(fit, effect, {"d": d}) for d in effect.free[0].grid[LATE]]
        return starts

    def late_sensors(self, fit: Fitted) -> list[Start]:
        """Return the starts of a fit with a delay of one sensor that is likelier than none.

        Each is filtered at a few delays with the noise and the track of the fit. The scan takes a
        late sample for the present state plus an offset, and the process noise of the fit for that
        of a log without delay. It is asked last: a log may look late until the actuator's delay
        and limits are found.
        """
        known = delayed(fit.hypothesis.effects)
        starts = [
            (fit.hypothesis.plus(effect, {"d": d}), fit.noise, fit.track)
            for effect in self.alone
            if not delayed([effect]) & known
            for d in effect.free[0].grid[:SOME_DELAYS]
        ]
        found = refine(self.predictor, starts, iterations=1, fixed_noise=True)
        best: dict[str, Fitted] = {}
        for one in sorted(found, key=self.score):
            if self.score(one) > self.score(fit):
                best[one.hypothesis.names[-1]] = one
        return [(one.hypothesis, one.noise, one.track) for one in best.values()]

    def without(self, fit: Fitted, name: str) -> Fitted:
        """Return a fit without one effect, noise and track kept, beside which rivals are sought."""
        start = (fit.hypothesis.minus(name), fit.noise, fit.track)
        alone = refine(self.predictor, [start], iterations=1, fixed_noise=True)
        return alone[0] if alone else self.best_null()

    def lacking(self, name: str) -> HypothesisSearch:
        """Return a search without one effect, with the fits that don't have it."""
        other = self.like(but=name)
        other._prices = self._prices
        other.keep([f for f in self.fits.values() if name not in f.hypothesis.names])
        return other


def undefined(predictor: Predictor) -> GroundedError:
    """Return the error for a model that does not give finite predictions along the log."""
    data, h = predictor.data, Hypothesis()
    with np.errstate(all="ignore"):
        after = predictor.next(h, data.y[:-1])
    bad = np.argwhere(~np.isfinite(after).all(axis=-1) & (data.valid.T > 0))
    if not len(bad):
        return refused("model.not_finite", data.model.name, then=NextCommand("fit"))
    t, b = bad[0]
    trial = data.ids[data.trial_of[b]] or f"number {data.trial_of[b] + 1}"
    values = ", ".join(
        f"{name} = {value:.4g}"
        for name, value in zip(data.model.state_names, data.y[t, b], strict=True)
    )
    at = f"{data.time[t, b]:.3g} s"
    return refused("model.not_finite", data.model.name, trial=trial, at=at, values=values)


MATTERS = 1e-3  # rms change of an input, relative to its spread, from which the order matters


def first(predictor: Predictor, h: Hypothesis) -> list[Hypothesis]:
    """Return a hypothesis with its latest effect acting first, if inputs then arrive otherwise."""
    latest, acting = len(h.effects) - 1, acting_order([effect.family for effect in h.effects])
    if latest not in acting or len(acting) < 2:
        return []
    places = iter([latest, *(i for i in acting if i != latest)])  # the others stay where they are
    order = [next(places) if i in acting else i for i in range(len(h.effects))]
    effects, values = tuple(h.effects[i] for i in order), tuple(h.values[i] for i in order)
    other = replace(h, effects=effects, values=values)
    u, v = predictor.inputs(h), predictor.inputs(other)
    apart, spread = np.sqrt(((u - v) ** 2).mean(axis=(0, 1))), u.std(axis=(0, 1))
    return [other] * bool((apart > MATTERS * np.maximum(spread, 1e-12)).any())
