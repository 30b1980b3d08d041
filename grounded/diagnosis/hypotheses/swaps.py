"""Change a set of effects without making it larger: other effects, one for several, other orders.

A set that grew one effect at a time may have begun with a wrong one, and each further effect then
fits what that one leaves. So the likeliest set of each size is changed in three ways:

    other effects   one of them is replaced by any other that fits better beside the rest
    one for several effects of single inputs are replaced by one of several inputs (`delay:a+b`)
    other orders    effects act on a command in another order: a gain before or after a rate limit

And the set that is to be claimed is rivalled by those that blame fewer inputs (`parted`).

Changed sets are compared only once they have converged, with constants of their own. A friction
with the constant of another law, or a rate limit before a gain that it really follows, can lack
hundreds of nats.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from grounded.diagnosis.hypotheses.orders import orders
from grounded.diagnosis.hypotheses.search import TO_THE_TOP, HypothesisSearch, Start
from grounded.diagnosis.hypotheses.tuning import tune
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.levels import NATS
from grounded.diagnosis.likelihood.refine import refine
from grounded.effects import Effect, InputFamily, MemoryFamily
from grounded.effects.actuator import delay

HOPEFUL = 4  # best sets of a size that are fitted to convergence
TUNED = 2  # best larger sets whose constants are optimised
ROUNDS = 3  # most rounds of swaps; after one, another may be better
AT_FIRST = 6  # iterations of the first fit of a swapped effect
LATE = ("delay", "first_order_lag", "rate_limit")  # one of all inputs replaces any of these


def swapped(search: HypothesisSearch, best: Fitted) -> Fitted:
    """Change a set of effects while its evidence rises; return the likeliest fit.

    All fits are added to the search. The result may have fewer effects than `best`.
    """
    size = len(best.hypothesis.effects)
    for _ in range(ROUNDS):
        known = {fit.hypothesis.names for fit in search.of_size(size)[:HOPEFUL]}
        for name in best.hypothesis.names:  # does another effect fit better beside the others?
            search.extended(search.without(best, name), AT_FIRST)
        search.refined(list(merged(search, best)), TO_THE_TOP)
        new = [f for f in search.of_size(size)[:HOPEFUL] if f.hypothesis.names not in known]
        search.finished(new, TO_THE_TOP)
        reordered(search, new)
        tune(search, [search.latest(fit) for fit in new])
        before, best = best, search.of_size(size)[0]
        if set(best.hypothesis.names) == set(before.hypothesis.names):
            break
    return max([best, *search.of_size(size - 1)[:1]], key=search.score)


def merged(search: HypothesisSearch, fit: Fitted) -> Iterator[Start]:
    """Yield a fit with one effect of several inputs in place of two or more effects of fewer.

    They are of the same family, or all of them make the inputs late.
    """
    for effect in search.candidates:
        targets, family = set(effect.site.targets), effect.family
        if len(targets) < 2 or not isinstance(family, InputFamily | MemoryFamily):
            continue
        kinds = LATE if family.name in LATE else (family.name,)
        old = [
            (e, v)
            for e, v in fit.hypothesis.pairs
            if e.family.name in kinds and set(e.site.targets) <= targets
        ]
        same = [v for e, v in old if e.family.name == family.name]
        if len(old) < 2 or not same:
            continue
        h = fit.hypothesis
        for other, _ in old:
            h = h.minus(other.name)
        values = {q.name: float(np.mean([v[q.name] for v in same])) for q in effect.free}
        yield h.plus(effect, values), fit.noise, fit.track


def parted(search: HypothesisSearch, fit: Fitted) -> list[Fitted]:
    """Return the fits of the sets that blame fewer inputs, or treat all of them alike.

    An effect of several inputs is replaced by the same effect of some of them; that of a car's
    steering had become one of its throttle too, at the price of one. A delay of all inputs, with
    something else that makes some of them later still, is replaced by a delay of each.
    """
    own, found = {e.name: e for e in search.candidates}, list[Fitted]()
    for h in _of_fewer_inputs(own, fit.hypothesis):
        key = (fit.noise.structure, h.spread, tuple(sorted(h.names)))
        known = search.fits.get(key)
        starts: list[Fitted | Start] = [(h, fit.noise, fit.track)]
        search.refined([*starts, known] if known else starts, TO_THE_TOP)
        found += [search.fits[key]] if key in search.fits else []
    return found


def _of_fewer_inputs(own: Mapping[str, Effect], h: Hypothesis) -> Iterator[Hypothesis]:
    for effect, values in h.pairs:
        family, targets = effect.family, {*effect.site.targets}
        if len(targets) < 2 or not isinstance(family, InputFamily | MemoryFamily):
            continue
        groups = {
            frozenset(e.site.targets): e
            for e in own.values()
            if e.family.name == family.name and {*e.site.targets} < targets
        }
        if family.name != delay.name:
            for part in groups.values():
                same = {q.name: values[q.name] for q in part.free}
                yield _in_place(h, {effect.name: (part, same)})
            continue
        for later, more in h.pairs:
            those = frozenset(later.site.targets)
            one, other = groups.get(frozenset(targets - those)), groups.get(those)
            if later.family.name in LATE and one is not None and other is not None:
                longer = {"d": values["d"] + more.get("d", more.get("tau", 0.0))}
                yield _in_place(h, {effect.name: (one, values), later.name: (other, longer)})


def _in_place(
    h: Hypothesis, others: Mapping[str, tuple[Effect, Mapping[str, float]]]
) -> Hypothesis:
    """Replace effects, by name, by others that act in the same order."""
    found = replace(h, effects=(), values=())
    for effect, values in h.pairs:
        found = found.plus(*others.get(effect.name, (effect, values)))
    return found


def reordered(search: HypothesisSearch, fits: Sequence[Fitted]) -> None:
    """Fit the sets of these fits with their effects on inputs in other orders, while they gain.

    Another order has to be clearly likelier. A dead zone before a gain, for example, is the same as
    another one after it.
    """
    for fit in fits:
        for _ in range(ROUNDS):
            starts = [(h, fit.noise, fit.track) for h in orders(search.predictor, fit.hypothesis)]
            found = refine(search.predictor, starts, iterations=TO_THE_TOP, worth=search.score)
            best = max(found, key=search.score, default=fit)
            if search.score(best) < search.score(search.latest(fit)) + NATS:
                break
            search.keep([best])
            fit = best
