"""The claimed effects with values and intervals; rejected ones, ties and look-alikes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from itertools import islice

import numpy as np

from grounded.diagnosis.hypotheses.explored import no_limits, parametric, sizeless
from grounded.diagnosis.hypotheses.lookalike import (
    moving,
    one_clock,
    related,
    twins,
)
from grounded.diagnosis.hypotheses.search import LARGE_GAIN, HypothesisSearch
from grounded.diagnosis.levels import NATS, SHARE, SURE
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.fitted import Fitted, calibrated, moved
from grounded.diagnosis.likelihood.intervals import NORMAL
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.parts import Estimate, Ranked
from grounded.diagnosis.validation.decide import Decision, averaged
from grounded.diagnosis.validation.identifiable import Identified, identified, values_of
from grounded.diagnosis.validation.limits import Limits, excitation
from grounded.diagnosis.validation.measured import Measured
from grounded.diagnosis.validation.ruler import Ruler
from grounded.effects import Effect, Library
from grounded.frozen import Array

RANKED = 12  # explanations that are listed

Params = dict[str, Estimate]


def _restated(name: str, other: str, rest: set[str]) -> bool:
    """Check whether another effect says the same beside the rest: `f:a+b` and `f:b` for f:a, f:b.

    A delay of all inputs, and a further one of each input but one, is a delay of each.
    """
    family, _, own = name.partition(":")
    like, _, targets = other.partition(":")
    others = {f"{family}:{target}" for target in targets.split("+")} - {name}
    return like == family and own in targets.split("+") and bool(others) and others <= rest


class Claims:
    """The effects that the decision claims, or the parameters if calibration is enough."""

    def __init__(
        self,
        decision: Decision,
        credit: dict[str, float],
        known: Limits,
        ruler: Ruler,
        uncertain: Predictor | None = None,
    ) -> None:
        """`uncertain`: evaluates hypotheses with those parameters free that the search held."""
        self.search, self.best, self.known = decision.search, decision.fit, known
        self.ruler, self.lost = ruler, decision.lost
        search, best, self.credit = decision.search, decision.fit, credit
        self.predictor, self.data = search.predictor, search.data
        self._uncertain = uncertain or search.predictor
        self.names, self._same = best.hypothesis.names, dict[tuple[str, str], bool]()
        calibrating = not self.names and best.hypothesis.spread > 0
        self.null = best if calibrating else search.best_null()
        self.base = search.score(decision.crude if parametric(best) else self.null)
        self.moved = self._known(moved_parameters(search, best, ruler))  # also beside effects
        self.blamed = self.moved if calibrating else {}
        self.alike = decision.alike
        late = [e for e, values in best.hypothesis.pairs if values.get("d", 0.0) >= 0]
        clock = one_clock(self.data.model, late, ruler.names, excitation(self.data).still)
        self.same = [] if known.no_cause else [*clock]

    def _known(self, off: dict[int, float]) -> dict[int, float]:
        """Return the parameters that are off by as much as trials agree on, if one clearly is.

        Evidence takes the model for right: trials may disagree by more than it says.
        """
        known, model = self.parameters() if off else {}, self.data.model
        values = {i: (known[model.param_names[i]], float(model.values[i])) for i in off}
        sizes = {i: abs(e.value - was) / max(e.std, 1e-300) for i, (e, was) in values.items()}
        if max(sizes.values(), default=0.0) < SURE:
            return off
        return {i: nats for i, nats in off.items() if sizes[i] > SURE}

    def ranking(self, measured: Measured) -> tuple[Ranked, ...]:
        """Return the claimed effects by credit, then rivals and rejected effects by evidence."""

        def row(fit: Fitted, name: str, evidence: float, of: Params | None = None) -> Ranked:
            h, claimed = fit.hypothesis, fit is self.best and not self.known.no_cause
            index = h.names.index(name) if of is None else -1
            params = self.estimates(fit)[index] if of is None else of
            fixed = h.effects[index].fixed if of is None else {}
            gap = measured.gap(fit)
            shrinkage = 1 - gap / before if before > 0 else 0.0
            return Ranked(name, params, fixed, evidence, gap, shrinkage, claimed)

        before = measured.gap(measured.decision.crude)
        best_first = sorted(self.names, key=lambda name: -self.credit.get(name, 0.0))
        rows = [row(self.best, n, self.lost[n]) for n in best_first]
        rows += [row(self.best, *one) for one in self.off()]
        listed = {one.effect for one in rows}
        tied = {n: one for n, one in self.tied().items() if n not in listed}
        rows += [row(fit, name, evidence) for name, (fit, evidence) in tied.items()]
        likely = (  # no absurd values
            f
            for f in self.search.of_size(1)
            if f.hypothesis.names[0] not in {*listed, *tied}
            and math.isfinite(self.search.score(f))
            and not no_limits(self.data, f.hypothesis)
            and not sizeless(f.hypothesis, self.search.sure(f)[0])
        )
        for f in islice(likely, max(RANKED - len(rows), 3)):
            rows.append(row(f, f.hypothesis.names[0], self.search.score(f) - self.base))
        return tuple(rows)

    def off(self) -> list[tuple[str, float, Params]]:
        """Return the model's own parameters that are off: name, evidence (NaN: too inexact), by."""
        model, known, found = self.data.model, self.parameters(), []
        for i, nats in self.blamed.items():
            name = model.param_names[i]
            by = known[name].moved(-float(model.values[i]))
            found.append((f"parameter:{name}", nats if nats > NATS else math.nan, {"d": by}))
        return found

    def estimates(self, fit: Fitted) -> list[dict[str, Estimate]]:
        """Return the values of each effect with standard deviations and intervals."""
        sure = np.array(self._sure if fit is self.best else self.search.sure(fit)).T.tolist()
        each = iter(sure)
        return [
            {
                q.name: _estimate(float(v[q.name]), s, w, q.unit)
                for q, (s, w) in zip(e.free, islice(each, len(e.free)), strict=True)
            }
            for e, v in fit.hypothesis.pairs
        ]

    @cached_property
    def _sure(self) -> tuple[Array, Array]:
        """Model-averaged standard deviations and half-widths of the claim's values, (C,) each.

        A fit may hold its parameters, or keep them to a fraction of their priors. Of values that
        only priors set, that would state what no data told; so they are as wide as these.
        """
        std, half = averaged(self.search, self.best, self.ruler)
        keys = [(e.name, q.name) for e in self.best.hypothesis.effects for q in e.free]
        wide = np.array([self.identified.std.get(key, 0.0) for key in keys])
        std[: len(keys)] = np.maximum(std[: len(keys)], wide)
        half[: len(keys)] = np.maximum(half[: len(keys)], NORMAL * wide)
        return std, half

    @cached_property
    def identified(self) -> Identified:
        """What the data determine beside the claim, and which values only priors set."""
        known = {name: Estimate(value, std) for name, value, std, _ in self._calibrated}
        return identified(self._uncertain, self.best, known, held_out=self.ruler.held_out)

    @cached_property
    def _calibrated(self) -> list[tuple[str, float, float, float]]:
        """The calibrated parameters by the fit: name, value, standard deviation, half-width."""
        values = values_of(self.best.hypothesis, self.data)
        sure = self.search.sure(self.best, thresholds=True)
        return [
            (one.quantity, one.value, float(std) * one.scale, float(half) * one.scale)
            for one, std, half in zip(values, *sure, strict=True)
            if not one.effect
        ]

    def groups(self) -> tuple[tuple[str, ...], ...]:
        """Return groups of indistinguishable explanations, the claimed one first in each.

        For a claimed effect these are rivals within a few nats and, if parameters are free, effects
        that are equivalent with other values of these. For parameters that are off, they are
        effects that are equivalent or as likely alone.
        """
        found = list[tuple[str, ...]]()
        blamed = [f"parameter:{self.data.model.param_names[i]}" for i in self.blamed]
        for own in blamed[:2]:
            near = (e.name for e in self.search.candidates if related(self._effect(own), e))
            found.append((own, *[name for name in near if self._twins(own, name)][:2]))
        said = {name for group in found for name in group}
        exact = [
            f
            for (_, spread, some), f in self.search.fits.items()
            if len(some) == 1 and spread == 0 and some[0] not in said and not parametric(f)
        ]
        for own in blamed[:1]:
            same = dict.fromkeys(f.hypothesis.names[0] for f in exact if self._as_likely(f))
            found.append((own, *list(same)[:2]))
        found += [(name, *(other for other, _ in self.rivals(name))) for name in self.names]
        found += [pair for pair in self.same if not any({*pair} <= {*group} for group in found)]
        return tuple(group for group in found if len(group) > 1)

    def equivalent(self, groups: tuple[tuple[str, ...], ...]) -> tuple[tuple[str, ...], ...]:
        """Return the groups that are equivalent in the model, which no trial can separate."""
        late = {*self.same}
        return tuple(
            (first, *others)
            for first, *others in groups
            if all((first, o) in late for o in others) or all(self._twins(first, o) for o in others)
        )

    def rivals(self, name: str) -> list[tuple[str, Fitted]]:
        """Return up to two effects that tie with a claimed one beside all the others, with fits.

        The rivals' parameters may be free though the claim's are not, or the other way round.
        """
        rest, score = set(self.names) - {name}, self.search.score
        free, fits = self.best.hypothesis.spread > 0, self.search.fits.values()
        without = max(score(f) for f in fits if set(f.hypothesis.names) <= rest)
        found: dict[str, Fitted] = {}  # likeliest first
        for f in sorted(fits, key=lambda f: -score(f)):
            h = f.hypothesis
            if len(h.names) != len(self.names) or len(set(h.names) - rest) != 1:
                continue
            (other,) = set(h.names) - rest
            # not if parameters that predictions refused make it likelier, or make all of it
            as_likely = abs(score(f) - score(self.best)) < NATS and score(f) > without + NATS
            needed = (h.spread > 0) == free or as_likely
            beyond = other in no_limits(self.data, h) or _restated(name, other, rest)
            beyond = beyond or self._adds(other, score(f) - without)
            if other not in (name, *found) and needed and not beyond and self._ties(name, other, f):
                found[other] = f
        return list(found.items())[:2]

    def _adds(self, other: str, nats: float) -> bool:
        """Check whether a rival, worth some nats in place of a claim, is worth as much beside it.

        Then it is another cause, and no other name of the claimed one: of a car, the drift of its
        carpet was worth 90 nats in place of the throttle's delay, and 147 beside it.
        """
        names, fits = {*self.names, other}, self.search.fits.values()
        free = self.best.hypothesis.spread > 0
        beside = [f for f in fits if names == {*f.hypothesis.names}]
        scores = [self.search.score(f) for f in beside if (f.hypothesis.spread > 0) == free]
        more = max(scores, default=-np.inf) - self.search.score(self.best)
        return more > max(LARGE_GAIN, 0.5 * nats)

    def _ties(self, name: str, other: str, fit: Fitted) -> bool:
        """Check whether a fit with another effect in place of one is as likely, or equivalent.

        Equivalent effects differ only in the integration of a step, but over hundreds of steps that
        adds up to nats. They tie if their priors (mainly those of the parameters) do.
        """
        score, best, b = self.search.score, self.best, self.search.tempering.factor
        if score(best) - score(fit) < NATS:
            return self._as_likely(fit)
        known, other_known = (score(f) - b * f.loglik for f in (best, fit))
        alike = (name, other) in self.alike
        return alike and abs(known - other_known) < NATS and self._twins(name, other)

    def _as_likely(self, fit: Fitted) -> bool:
        """Check whether a fit is as likely as the claim, or likelier and predicts as well."""
        more = self.search.score(fit) - self.search.score(self.best)
        refused = more > NATS and self.ruler.held_out and self.ruler.gain(fit, self.best).clear
        return more > -NATS and not refused

    def _twins(self, name: str, other: str) -> bool:
        """Check whether two effects are equivalent with other values of the free parameters.

        Their own signals may be opposite: a weaker right thruster is a stronger left one with less
        thrust of both.
        """
        key = name, other
        if key not in self._same:
            one, two = map(self._effect, key)
            free = moving(self.data, self.best.hypothesis)
            self._same[key] = bool(one and two and twins(self.predictor, one, two, free))
        return self._same[key]

    def _effect(self, name: str) -> Effect | None:
        """Return a candidate, or a parameter of the model as an effect; None if it is neither."""
        every = {e.name: e for e in (*self.search.joints.values(), *self.search.candidates)}
        own = name.removeprefix("parameter:") in self.data.model.params
        return every.get(name) or (Library().effect(name, self.data.model) if own else None)

    def tied(self) -> dict[str, tuple[Fitted, float]]:
        """Return each rival's fit in place of a claimed effect, and its evidence there."""
        best, found = self.search.score(self.best), dict[str, tuple[Fitted, float]]()
        for name in self.names:
            for other, fit in self.rivals(name):
                found.setdefault(other, (fit, self.lost[name] + self.search.score(fit) - best))
        return found

    def parameters(self) -> dict[str, Estimate]:
        """Return the values of the model's parameters, if they were calibrated."""
        found = {}
        for name, value, std, half in self._calibrated:
            param, wide = self.data.model.params[name], self.identified.std.get(("", name), 0.0)
            std, half = max(std, wide), max(half, NORMAL * wide)
            one = _estimate(value, std, half, param.unit)
            found[name] = replace(one, std=std, stopped=param.stopped(value))
        return found


def _estimate(value: float, std: float, half: float, unit: str) -> Estimate:
    """Return an estimate with its interval; its standard deviation is infinite if unknown."""
    found = Estimate(value, std, (value - half, value + half), unit)
    return found if found.known else Estimate(value, math.inf, None, unit)


def loss(H: Array, b: Array, free: list[int]) -> float:
    """Return the loss of log posterior if only `free` shifts may differ from zero [nats].

    It is b' (H_rr - H_rS H_SS^-1 H_Sr) b / 2, with S the free ones, r the others, b their shifts.
    """
    rest = [i for i in range(len(b)) if i not in free]
    if not rest:
        return 0.0
    block, left = H[np.ix_(rest, rest)], b[rest]
    if free:
        across = H[np.ix_(rest, free)]
        block = block - across @ np.linalg.pinv(H[np.ix_(free, free)], hermitian=True) @ across.T
    return 0.5 * float(left @ block @ left)


def moved_parameters(search: HypothesisSearch, fit: Fitted, ruler: Ruler) -> dict[int, float]:
    """Return the parameters of a calibrated fit that must differ from nominal, by importance.

    These are indices in the model, each with the loss at its nominal value [nats]. The log
    posterior of the shifts is approximated by a parabola at the fit, with curvature H (`loss`).
    Evidence selects as few as possible, so that the others gain less than NATS. Of these, one
    after another is left out, the least needed first, if predictions with it at nominal, the others
    fitted again, are as good. So of two that can do each other's work (a gain and a time constant
    of which the data only determine a combination), one stays.
    """
    data, h = search.data, fit.hypothesis
    if h.spread == 0 or h.shift is None:
        return {}
    k, which = len(h.theta), calibrated(data)
    G = fit.gram.sum(axis=0)
    across = G[k:, :k]
    H = G[k:, k:] - across @ np.linalg.pinv(G[:k, :k], hermitian=True) @ across.T
    H = H + np.diag(fit.prior[k:])
    b = h.shift[which] / data.model.spreads[which]
    free, now = fewest(H, b, range(len(b)))
    nats = {i: loss(H, b, [j for j in free if j != i]) - now for i in free}
    if ruler.held_out:
        least = SHARE * ruler.since_outset(fit)
        rest = fit
        gains = {i: ruler.gain(unmoved(data, fit, k + i), fit).mean for i in free}
        for i in sorted(free, key=lambda i: gains[i])[:-1]:
            less = unmoved(data, rest, k + i)  # beside those left out already, which may hide it
            if gains[i] < least and ruler.gain(less, fit).mean < least:
                free, rest = [j for j in free if j != i], less
    # the parabola can't gain more than the fit itself
    whole = max(search.score(fit) - search.score(search.exact_null()), 0.0)
    by = sorted(free, key=lambda i: -nats[i])
    return {int(which[i]): min(search.tempering.factor * nats[i], whole) for i in by}


def fewest(H: Array, b: Array, allowed: Sequence[int]) -> tuple[list[int], float]:
    """Select as few of the allowed shifts as possible; return them and what the others lose.

    They are added one by one, each time the one that lowers the loss most, until it is below NATS.
    """
    free: list[int] = []
    now = loss(H, b, free)
    while len(free) < len(allowed) and (now > NATS or not free):
        losses = {i: loss(H, b, [*free, i]) for i in allowed if i not in free}
        i = min(losses, key=lambda j: losses[j])
        free, now = [*free, i], losses[i]
    return free, now


def unmoved(data: Data, fit: Fitted, column: int) -> Fitted:
    """Return the fit with one parameter at nominal, the others fitted again by a Newton step."""
    h, index = fit.hypothesis, calibrated(data)[column - len(fit.hypothesis.theta)]
    assert h.shift is not None
    shift = h.shift[index] / data.model.spreads[index]
    H = fit.gram.sum(axis=0) + np.diag(fit.prior)
    rest = np.delete(np.arange(len(H)), column)
    delta = np.zeros(len(H))
    delta[column] = -shift
    delta[rest] = shift * np.linalg.pinv(H[np.ix_(rest, rest)], hermitian=True) @ H[rest, column]
    gram, score = fit.gram.copy(), fit.score - fit.gram @ delta
    gram[:, column], gram[..., column], score[:, column] = 0.0, 0.0, 0.0  # it is fixed there
    return replace(fit, hypothesis=moved(data, fit.hypothesis, delta), gram=gram, score=score)
