"""The rule that decides what is claimed: the smallest set of causes that predicts as well as any.

Search proposes, this rule claims. Every set of causes that was fitted is an `Option`: its errors
where its values were not fitted (`ruler`, by group of trials). The rule has four steps:

    1. A set is *supported* if it is better than without any one of its causes. *Better* is a set
       whose predictions are better by ERRORS of their standard error and, if it is larger, that is
       likelier (PICKED nats). If it is as small, it may be less likely by as much only if its
       predictions are clearly better, and by SHOWS. A cause that a guard refuses is not supported,
       nor one that gains less than matters (LEAST, and SHARE of what the set gains).
    2. The *reference* is the supported set that predicts best.
    3. Of the supported sets that the reference is not better than, the smallest is chosen: the
       one-standard-error rule of Breiman et al. (1984), and of projection predictive selection
       (Piironen & Vehtari 2017). If the reference predicts clearly better, and by SHOWS, evidence
       must not contradict it by PICKED, but need not be for it.
       A set that predicts worse than the model without effects, calibrated or not, is claimed with
       calibrated parameters, or not at all if that predicts worse, too.
    4. Of those that are as small, the likeliest, a calibrated one with PICKED nats more: what all
       parameters explain, each a little off, one more effect can imitate. Within NATS nats they
       tie: then a parameter comes before a mechanism, and that before what has no mechanism, what
       acts on one input before what acts on several (`Option.order`). A supported set that is no
       larger replaces the choice if it predicts better and is likelier by PICKED.

A cause is an effect, or the calibration of the model's own parameters. `benchmarks/decide.py` draws
each number's curve.

A gain in predictions is the log ratio of errors, paired by trial (in a single log by the runs that
it is cut into): of each trial the mean over channels and horizons, and of the trials the mean with
its standard error. Each trial's errors are damped by the mean error,

    log((e1^2 + e^2) / (e2^2 + e^2)),        e^2: mean of both sets over all trials

so that none dominates: where a cause does not act it adds neither gain nor scatter. Trials are few
and differ in how much of a cause they contain, so that even a large one may gain little more than
the standard error: what one of many trials gains is just one. So a little less than that is asked
of predictions, and more of the evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from grounded.diagnosis.error_report import CALIBRATION
from grounded.diagnosis.levels import ERRORS, LEAST, NATS, PICKED, SHARE, SHOWS, SURE
from grounded.frozen import Array


@dataclass(frozen=True, eq=False)
class Option:
    """A fitted set of causes.

    Args:
        causes: names of its effects, and "calibration" if the parameters are free.
        errors: held-out errors.
        order: of its causes, summed up: 0 a parameter, 1 a mechanism, 2 without a mechanism; then
            the number of states or inputs that they act on.
    """

    causes: frozenset[str]
    errors: Errors
    order: tuple[int, int] = (0, 0)

    @property
    def size(self) -> int:
        """Number of its causes, of which calibration, of several parameters, counts as two."""
        return len(self.causes) + (CALIBRATION in self.causes)


@dataclass(frozen=True, eq=False)
class Choice:
    """What the rule chose, and the reference that it was measured by."""

    chosen: Option
    reference: Option
    lost: float  # log gain of the reference over the chosen set
    standard_error: float


class Rule:
    """The rule, applied to one set of options.

    Args:
        options: the fitted sets, of each at most one, with the set without any cause.
        gain: compares the errors of two options.
        nats: returns how much likelier a second option is, priced and tempered [nats].
        less: returns a set without one cause, fitted if it was not; None if it can't be, or if a
            guard refuses the cause.
        held_out: False if nothing could be held out; then evidence alone decides.
        outset: errors of the model before anything was adopted; of the set without causes if None.
    """

    def __init__(
        self,
        options: Sequence[Option],
        gain: Callable[[Errors, Errors], Gain],
        nats: Callable[[Option, Option], float],
        less: Callable[[Option, str], Option | None],
        *,
        held_out: bool = True,
        outset: Errors | None = None,
    ) -> None:
        self.options, self.gain, self.nats, self.less = list(options), gain, nats, less
        self.held_out = held_out
        self.outset = outset or next(o.errors for o in options if not o.causes)
        self._need: dict[tuple[frozenset[str], str], bool] = {}

    def choose(self) -> Choice:
        """Return the smallest supported set that predicts as well as the best one."""
        none = next(option for option in self.options if not option.causes)
        if not self.held_out:
            by = sorted(self.options, key=lambda option: -self.nats(none, option))
            likeliest = next(option for option in by if self.supported(option))
            return Choice(likeliest, likeliest, 0.0, 0.0)
        by = sorted(self.options, key=self.gained, reverse=True)
        reference = next(option for option in by if self.supported(option))
        near = [o for o in by if not self._outdone(o, reference) and self.supported(o)]
        claims = [(option, claim) for option in near if (claim := self._claimed(option))]
        least = min(len(option.causes) for option, _ in claims)
        small = [pair for pair in claims if len(pair[0].causes) == least]
        nats = {option.causes: self._evidence(none, option) for option, _ in small}
        tied = [pair for pair in small if nats[pair[0].causes] > max(nats.values()) - NATS]
        _, chosen = min(tied, key=lambda pair: (pair[0].order, -nats[pair[0].causes]))
        chosen = self._surpassed(chosen)
        apart = self.gain(chosen.errors, reference.errors)
        return Choice(chosen, reference, apart.mean, apart.paired[1])

    def _outdone(self, option: Option, reference: Option) -> bool:
        """Check whether the reference is better than a set, or clearly predicts better."""
        gain = self.gain(option.errors, reference.errors)
        shows = gain.clear and gain.mean > SHOWS and self.nats(option, reference) > -PICKED
        return shows or self.better(option, reference)

    def _evidence(self, none: Option, option: Option) -> float:
        """Return how likely a set is where calibration competes with one more effect [nats]."""
        return self.nats(none, option) + PICKED * (CALIBRATION in option.causes)

    def _surpassed(self, chosen: Option) -> Option:
        """Return the likeliest supported set, no larger, that predicts better and is likelier."""
        least = self.gained(chosen)
        small = [o for o in self.options if o.size <= chosen.size and self.gained(o) > least]
        likelier = [o for o in small if self.nats(chosen, o) > PICKED and self.supported(o)]
        if not likelier:
            return chosen
        return self._surpassed(max(likelier, key=lambda option: self.nats(chosen, option)))

    def _claimed(self, option: Option) -> Option | None:
        """Return a set, or its calibrated form, if it predicts no worse than no effects do."""
        bare = [o for o in self.options if o.causes <= {CALIBRATION} and self.supported(o)]
        least = max(map(self.gained, bare)) - LEAST
        calibrated = (o for o in self.options if o.causes == option.causes | {CALIBRATION})
        for claim in (option, *calibrated):
            if claim not in bare and self.gained(claim) < least:
                continue
            if self.supported(claim, claim.causes - {CALIBRATION}):
                return claim
        return None

    def gained(self, option: Option) -> float:
        """Return the gain since the outset."""
        return self.gain(self.outset, option.errors).mean

    def supported(self, option: Option, causes: frozenset[str] | None = None) -> bool:
        """Check whether a set needs each of some of its causes (None: of all)."""
        asked = sorted(option.causes if causes is None else causes)
        return all(self._needed(option, cause) for cause in asked)

    def refuse(self, option: Option, causes: Sequence[str]) -> None:
        """Take some causes of a set for unsupported from now on."""
        self._need |= dict.fromkeys(((option.causes, c) for c in causes), False)

    def better(self, before: Option, after: Option) -> bool:
        """Check whether one set predicts better than another, and evidence does not contradict."""
        larger = after.size > before.size
        if larger and not self.nats(before, after) >= PICKED:  # also of none
            return False
        if not self.held_out:
            return True
        gain = self.gain(before.errors, after.errors)
        if larger or not gain.pays or (gain.clear and gain.mean > SHOWS):
            return gain.pays
        return self.nats(before, after) > -PICKED

    def _needed(self, option: Option, cause: str) -> bool:
        """Check whether a set is better with a cause, by enough of what it gains."""
        known = self._need.get((option.causes, cause))
        if known is None:
            less = self.less(option, cause)
            known = less is not None and self.better(less, option)
            if less is not None and known and self.held_out:
                more = self.gain(less.errors, option.errors).mean
                known = more >= SHARE * max(self.gained(option), 0.0)
            self._need[option.causes, cause] = known
        return known


@dataclass(frozen=True, eq=False)
class Errors:
    """Sums of squared errors and their counts by horizon, piece and state, (K, P, n) each."""

    total: Array
    count: Array

    @cached_property
    def rms(self) -> Array:
        """Rms errors by horizon and state, (K, n); NaN where nothing was measured."""
        total, count = self.total.sum(axis=1), self.count.sum(axis=1)
        return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


@dataclass(frozen=True)
class Gain:
    """Improvement of one hypothesis over another: log ratio of errors, and how sure it is."""

    mean: float  # of the rms errors over all trials, mean over channels and horizons
    largest: float  # the same of any channel and horizon
    channels: Array  # (n',) the same by shown state, mean over horizons
    paired: tuple[float, float]  # mean over trials of each trial's damped gain, its standard error
    whole: tuple[float, float] = (0.0, 0.0)  # the same of whole trials

    @property
    def ruins(self) -> bool:
        """Whether predictions of whole trials are clearly worse."""
        return self.whole[0] < -max(SURE * self.whole[1], LEAST)

    @property
    def clear(self) -> bool:
        """Whether predictions are clearly better."""
        return self._by(SURE)

    @property
    def pays(self) -> bool:
        """Whether predictions are better, by a little less than what one of many trials gains."""
        return self._by(ERRORS)

    def _by(self, errors: float) -> bool:
        return self.paired[0] > errors * self.paired[1] and self.largest > LEAST


@dataclass(frozen=True, eq=False)
class Comparison:
    """How errors of two hypotheses on the same trials are compared.

    Args:
        shown: (n',) states that are compared.
        matters: (K, n') errors below which differences do not matter.
        unit: (P,) unit of each piece: its trial, or in a single log its run.
    """

    shown: Any
    matters: Array
    unit: Any

    def __call__(self, before: Errors, after: Errors) -> Gain:
        """Return the gain of one set of errors over another."""
        a, b, count = (self._by_unit(v) for v in (before.total, after.total, before.count))
        least = self.matters[:, None] ** 2

        # over all trials: by horizon and state
        sums = [v.sum(axis=1, keepdims=True) for v in (a, b, count)]
        ratio = 0.5 * log_ratio(sums[0], sums[1], sums[2] * least)
        seen = np.maximum((sums[2] > 0).sum(axis=(0, 1)), 1)

        # trial by trial, each with as much of the mean error as it has samples
        usual = count * ((sums[0] + sums[1]) / 2 / np.maximum(sums[2], 1) + least)
        each = log_ratio(a, b, usual)
        return Gain(
            float(ratio.sum() / max((sums[2] > 0).sum(), 1)),
            float(ratio.max()),
            ratio.sum(axis=(0, 1)) / seen,
            over_trials(each, count > 0),
            over_trials(each[-1:], count[-1:] > 0),
        )

    def _by_unit(self, values: Array) -> Array:
        """Return sums over pieces by unit, (K, U, n') of (K, P, n)."""
        found = np.zeros((len(values), int(self.unit.max()) + 1, len(self.shown)))
        for k, one in enumerate(values[..., self.shown]):
            np.add.at(found[k], self.unit, one)
        return found


def log_ratio(before: Array, after: Array, beside: Array) -> Array:
    """Return the logarithm of a ratio of sums of squares with something added to both."""
    return np.asarray(np.log((before + beside + 1e-300) / (after + beside + 1e-300)))


def over_trials(each: Array, seen: Any) -> tuple[float, float]:
    """Return the mean over trials, and its standard error, of gains (K, U, n') where seen."""
    known = seen.any(axis=(0, 2))
    by = (each * seen).sum(axis=(0, 2))[known] / seen.sum(axis=(0, 2))[known]
    if len(by) < 2:
        return float(by.sum()), np.inf
    return float(by.mean()), float(by.std(ddof=1) / np.sqrt(len(by)))


def jackknife(each: Array) -> Array:
    """Return the jackknife standard error from the means without each unit, (U, ...) -> (...)."""
    count = len(each)
    if count < 2:
        return np.full(each.shape[1:], np.inf)
    return np.asarray(np.sqrt((count - 1) / count * ((each - each.mean(axis=0)) ** 2).sum(axis=0)))
