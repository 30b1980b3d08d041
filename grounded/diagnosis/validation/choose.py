"""The rule that decides what is claimed: the smallest set of causes that predicts as well as any.

Search proposes, this rule claims. Every set of causes that was fitted is an `Option`: its evidence,
and its errors where its values were not fitted (`ruler`, by group of trials). The rule has four
steps:

    1. A set is *supported* if each of its causes is: with it the set is likelier (PICKED nats), and
       predictions are better by more than their standard error and as much as matters (LEAST, and
       SHARE of what the set gains). A cause that a guard refuses is not supported.
    2. The *reference* is the supported set that predicts best.
    3. Of the supported sets that the reference predicts no better than, by the same test of
       predictions, the smallest is chosen: the one-standard-error rule of Breiman et al. (1984),
       and of projection predictive selection (Piironen & Vehtari 2017).
    4. Of those that are as small, the likeliest. Within NATS nats they tie: then a parameter comes
       before a mechanism, and that before what has no mechanism (`Option.order`).

A cause is an effect, or the calibration of the model's own parameters. `benchmarks/decide.py` draws
each number's curve.

The gain in predictions is the mean log ratio of rms errors over channels and horizons; its standard
error is the jackknife's over trials (in a single log, over the runs that it is cut into). Trials are
few and differ in how much of an effect they contain, so that even a large effect gains little more
than its standard error: surer predictions are not asked for, and more nats of evidence instead.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from grounded.diagnosis.levels import ERRORS, LEAST, NATS, PICKED, SHARE, SURE
from grounded.frozen import Array


@dataclass(frozen=True, eq=False)
class Option:
    """A fitted set of causes.

    Args:
        causes: names of its effects, and "calibration" if the parameters are free.
        evidence: log evidence, priced and tempered [nats].
        errors: held-out errors.
        order: of its causes: 0 a parameter, 1 a mechanism, 2 without a mechanism, summed up.
    """

    causes: frozenset[str]
    evidence: float
    errors: Errors
    order: int = 0


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
        less: returns a set without one cause, fitted if it was not; None if it can't be, or if a
            guard refuses the cause.
        held_out: False if nothing could be held out; then evidence alone decides.
        outset: errors of the model before anything was adopted; of the set without causes if None.
    """

    def __init__(
        self,
        options: Sequence[Option],
        gain: Callable[[Errors, Errors], Gain],
        less: Callable[[Option, str], Option | None],
        *,
        held_out: bool = True,
        outset: Errors | None = None,
    ) -> None:
        self.options, self.gain, self.less, self.held_out = list(options), gain, less, held_out
        self.outset = outset or next(o.errors for o in options if not o.causes)
        self._unsupported: dict[frozenset[str], list[str]] = {}

    def choose(self) -> Choice:
        """Return the smallest supported set that predicts as well as the best one."""
        if not self.held_out:
            by = sorted(self.options, key=lambda option: -option.evidence)
            likeliest = next(option for option in by if not self.unsupported(option))
            return Choice(likeliest, likeliest, 0.0, 0.0)
        by = sorted(self.options, key=self.gained, reverse=True)
        reference = next(option for option in by if not self.unsupported(option))
        near = [o for o in by if not self.gain(o.errors, reference.errors).pays]
        for size in sorted({len(option.causes) for option in near}):
            small = [o for o in near if len(o.causes) == size and not self.unsupported(o)]
            if small:
                break
        most = max(option.evidence for option in small)
        tied = [option for option in small if option.evidence > most - NATS]
        chosen = min(tied, key=lambda option: (option.order, -option.evidence))
        apart = self.gain(chosen.errors, reference.errors)
        return Choice(chosen, reference, apart.mean, apart.scatter)

    def gained(self, option: Option) -> float:
        """Return the mean log gain since the outset."""
        return self.gain(self.outset, option.errors).mean

    def unsupported(self, option: Option) -> list[str]:
        """Return the causes of a set that it does not need, or that a guard refuses."""
        known = self._unsupported.get(option.causes)
        if known is None:
            known = [c for c in sorted(option.causes) if not self._needed(option, c)]
            self._unsupported[option.causes] = known
        return known

    def refuse(self, option: Option, causes: list[str]) -> None:
        """Take some causes of a set for unsupported from now on."""
        self._unsupported[option.causes] = causes

    def _needed(self, option: Option, cause: str) -> bool:
        """Check whether a set is likelier and predicts better with one of its causes."""
        less = self.less(option, cause)
        if less is None or not option.evidence - less.evidence >= PICKED:  # also of no evidence
            return False
        more = self.gain(less.errors, option.errors)
        matters = more.mean >= SHARE * max(self.gained(option), 0.0)
        return not self.held_out or (matters and more.pays)


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
    """Improvement of one hypothesis over another: mean log ratio of errors, and how sure it is."""

    mean: float
    scatter: float  # its jackknife standard error
    largest: float  # of any channel and horizon
    channels: Array  # (n',) mean over horizons, by shown state
    whole: tuple[float, float] = (0.0, 0.0)  # gain over whole trials and its standard error

    @property
    def ruins(self) -> bool:
        """Whether predictions of whole trials are clearly worse."""
        return self.whole[0] < -max(SURE * self.whole[1], LEAST)

    @property
    def clear(self) -> bool:
        """Whether predictions are clearly better."""
        return self.mean > SURE * self.scatter and self.largest > LEAST

    @property
    def pays(self) -> bool:
        """Whether predictions are better by more than their standard error.

        What one of many trials alone gains is one standard error.
        """
        return self.mean > ERRORS * self.scatter and self.largest > LEAST


@dataclass(frozen=True, eq=False)
class Comparison:
    """How errors of two hypotheses on the same trials are compared.

    Args:
        shown: (n',) states that are compared.
        matters: (K, n') errors below which differences do not matter.
        unit: (P,) jackknife unit of each piece: its trial, or in a single log its run.
    """

    shown: Any
    matters: Array
    unit: Any

    def __call__(self, before: Errors, after: Errors) -> Gain:
        """Return the gain of one set of errors over another."""
        a, b = (self._by_unit(errors.total) for errors in (before, after))
        count = self._by_unit(before.count).sum(axis=1, keepdims=True)
        seen, least = count > 0, count * self.matters[:, None] ** 2 + 1e-300

        def ratio(x: Array, y: Array) -> Array:
            return np.asarray(np.where(seen, 0.5 * np.log((x + least) / (y + least)), 0.0))

        def without(x: Array) -> Array:
            return np.asarray(np.maximum(x.sum(axis=1, keepdims=True) - x, 0.0))

        whole = ratio(a.sum(axis=1, keepdims=True), b.sum(axis=1, keepdims=True))
        counts = np.maximum(seen.sum(axis=(0, 1)), 1)
        each, some = ratio(without(a), without(b)), max(int(seen.sum()), 1)
        by, last = each.sum(axis=0), max(int(seen[-1].sum()), 1)
        return Gain(
            float(whole.sum() / some),
            float(jackknife(by.sum(axis=-1) / some)),
            float(whole.max()),
            whole.sum(axis=(0, 1)) / counts,
            (float(whole[-1].sum() / last), float(jackknife(each[-1].sum(axis=-1) / last))),
        )

    def _by_unit(self, values: Array) -> Array:
        """Return sums over pieces by unit, (K, U, n') of (K, P, n)."""
        found = np.zeros((len(values), int(self.unit.max()) + 1, len(self.shown)))
        for k, one in enumerate(values[..., self.shown]):
            np.add.at(found[k], self.unit, one)
        return found


def jackknife(each: Array) -> Array:
    """Return the jackknife standard error from the means without each unit, (U, ...) -> (...)."""
    count = len(each)
    if count < 2:
        return np.full(each.shape[1:], np.inf)
    return np.asarray(np.sqrt((count - 1) / count * ((each - each.mean(axis=0)) ** 2).sum(axis=0)))
