"""Variations of a set of effects that say the same in other terms, for the rule to choose from.

A set that grew one effect at a time may blame more than it needs, or name an effect that another
one contains. So it is varied, and every variation is fitted until it converges:

    one for several effects of single inputs become one of several inputs (`delay:a+b`)
    late            a delay becomes a filter, of a sensor or of inputs, or the other way round
    fewer inputs    an effect of several inputs becomes one of some of them, or one of each
    plain friction  a richer friction of a joint becomes its plain dry friction
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from grounded.diagnosis.hypotheses.search import TO_THE_TOP, HypothesisSearch
from grounded.diagnosis.levels import NATS
from grounded.diagnosis.likelihood.delays import delayed
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.effects import Effect, InputFamily, MemoryFamily
from grounded.effects.actuator import delay
from grounded.effects.drive import motion_of, push
from grounded.effects.joint import joint_friction, load_friction

HOPEFUL = 4  # best sets of a size that are fitted to convergence
AS_LATE = {"sensor_delay": "sensor_lag", "delay": "first_order_lag"}
AS_LATE |= {lag: delay for delay, lag in AS_LATE.items()}
LATE = ("delay", "first_order_lag", "rate_limit")  # one of all inputs replaces any of these

Change = Mapping[
    str, tuple[tuple[Effect, Mapping[str, float]], ...]
]  # effect -> those in its place


def varied(search: HypothesisSearch, fit: Fitted) -> Fitted:
    """Fit the variations of a set; return the likeliest that is not larger, or the set itself.

    Those of other effects that have converged are not fitted again.
    """
    own, noise = frozenset(fit.hypothesis.names), fit.noise
    known = {
        frozenset(names)
        for (structure, spread, names), f in search.fits.items()
        if f.settled and (structure, spread) == (noise.structure, fit.hypothesis.spread)
    }
    starts = []
    for h in variations(search, fit.hypothesis):
        if (names := frozenset(h.names)) not in known or names == own:
            known.add(names)
            late = delayed(h.effects) != delayed(fit.hypothesis.effects)
            starts.append(search.fresh_as(fit, h) if late else (h, noise, fit.track))
    found = search.refined(starts, TO_THE_TOP)
    size = len(fit.hypothesis.effects)
    small = [f for f in map(search.latest, found) if len(f.hypothesis.effects) <= size]
    best = max([fit, *small], key=search.score)
    return varied(search, best) if search.score(best) > search.score(fit) + NATS else best


def variations(search: HypothesisSearch, h: Hypothesis) -> Iterator[Hypothesis]:
    """Yield a set with one effect for several, with fewer inputs, and with plain frictions."""
    own = {effect.name: effect for effect in search.candidates}
    for change in (*merged(own, h), *parted(own, h), *as_late(own, h), *plainer(search, h)):
        yield in_place(h, change)


def merged(own: Mapping[str, Effect], h: Hypothesis) -> Iterator[Change]:
    """Yield one effect of several inputs in place of two or more effects of fewer.

    They are of the same family, or all of them make the inputs late.
    """
    for effect in own.values():
        targets, family = set(effect.site.targets), effect.family
        if len(targets) < 2 or not isinstance(family, InputFamily | MemoryFamily):
            continue
        kinds = LATE if family.name in LATE else (family.name,)
        of_fewer = (p for p in h.pairs if p[0].family.name in kinds)
        old = [(e, v) for e, v in of_fewer if set(e.site.targets) <= targets]
        same = [v for e, v in old if e.family.name == family.name]
        if len(old) > 1 and same:
            values = {q.name: float(np.mean([v[q.name] for v in same])) for q in effect.free}
            gone: Change = {e.name: () for e, _ in old}
            yield {**gone, old[-1][0].name: ((effect, values),)}


def parted(own: Mapping[str, Effect], h: Hypothesis) -> Iterator[Change]:
    """Yield an effect of some inputs, or one of each, in place of one effect of several inputs.

    A delay of all inputs, with something else that makes some of them later still, is also replaced
    by a delay of each.
    """
    for effect, values in h.pairs:
        family, targets = effect.family, {*effect.site.targets}
        if len(targets) < 2 or not isinstance(family, InputFamily | MemoryFamily) or effect.known:
            continue
        parts = {
            frozenset(e.site.targets): e
            for e in own.values()
            if e.family.name == family.name and {*e.site.targets} < targets
        }
        same = {q.name: values[q.name] for q in effect.free}
        each = [parts.get(frozenset({target})) for target in effect.site.targets]
        if family.name in LATE and None not in each:
            yield {effect.name: tuple((e, same) for e in each if e and e.name not in h.names)}
        if family.name != delay.name:
            yield from ({effect.name: ((part, same),)} for part in parts.values())
            continue
        for later, more in h.pairs:
            those = frozenset(later.site.targets)
            one, other = parts.get(frozenset(targets - those)), parts.get(those)
            if later.family.name in LATE and one is not None and other is not None:
                longer = {"d": values["d"] + more.get("d", more.get("tau", 0.0))}
                yield {effect.name: ((one, values),), later.name: ((other, longer),)}


def as_late(own: Mapping[str, Effect], h: Hypothesis) -> Iterator[Change]:
    """Yield a delay in place of a filter of the same sensor or inputs, or the other way round."""
    for effect, values in h.pairs:
        other = own.get(f"{AS_LATE.get(effect.family.name)}:{'+'.join(effect.site.targets)}")
        if other is not None and not effect.known:
            yield {effect.name: ((other, {other.free[0].name: values[effect.free[0].name]}),)}


def plainer(search: HypothesisSearch, h: Hypothesis) -> Iterator[Change]:
    """Yield the plain dry friction of a joint in place of a law with more values, or of a rate.

    A friction that depends on the load, or one beside a stiction, or with a viscous part, contains
    it. An added Coulomb rate can't hold a joint at rest, so any richer friction that can would win
    for that reason alone.
    """
    by_family = {(e.family.name, motion_of(e)): (e, v) for e, v in h.pairs}
    for (family, motion), (effect, values) in by_family.items():
        joint = search.joints.get(motion)
        if joint is not None and family == load_friction.name:
            same = {q.name: float(values[q.name]) for q in joint.quantities}
            yield {effect.name: ((joint, same),)}
        if joint is not None and family == "coulomb_friction":
            own = (joint, {"c": values["c"] / push(joint.site.model, joint.site.joined), "b": 0.0})
            if (stiction := by_family.get(("stiction", motion))) is not None:
                yield {effect.name: (), stiction[0].name: (own,)}
            if len(joint.free) == 1:
                yield {effect.name: (own,)}
    viscous = [p for p in h.pairs if p[0].family.name == joint_friction.name and _viscous(p[0])]
    for some in (*([one] for one in viscous if one[1].get("b") == 0), viscous[1:] and viscous):
        if some:
            yield {e.name: ((_dry(e), {**v, "b": 0.0}),) for e, v in some}


def _viscous(effect: Effect) -> bool:
    return "b" not in effect.fixed


def _dry(effect: Effect) -> Effect:
    """Return a joint's friction without its viscous part."""
    some = (replace(q, fixed=q.fixed or q.name == "b") for q in effect.quantities)
    return replace(effect, quantities=tuple(some))


def in_place(h: Hypothesis, change: Change) -> Hypothesis:
    """Replace effects, by name, by others that act in the same place of the order."""
    found = replace(h, effects=(), values=())
    for effect, values in h.pairs:
        for other, own in change.get(effect.name, ((effect, values),)):
            found = found.plus(other, own)
    return found
