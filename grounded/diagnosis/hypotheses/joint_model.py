"""All joints of an arm at once: dry and viscous friction and inertia of each, then what is needed.

Of an arm whose every joint differs from its model none moves as the model says by the friction of
one. Alone each true effect gains little, and a weak input of all joints goes before it, so a search
that adds one effect at a time never gets there. Here the search starts from the other end, from
what an identification of robots fits: every joint with friction and a rotor's inertia. What the
evidence does not need is taken out again, one by one; what it still needs is added.

Source: Swevers, Verdonck & De Schutter, Dynamic Model Identification for Industrial Robots (2007);
the order of the removals is Wald's test (values against their covariance), each is fitted again.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from grounded.diagnosis.hypotheses.explored import CLAIM
from grounded.diagnosis.hypotheses.plainest import push
from grounded.diagnosis.hypotheses.search import (
    CRUDE,
    TO_THE_TOP,
    HypothesisSearch,
    Start,
    tune,
)
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.hypothesis import Hypothesis, param_scale
from grounded.diagnosis.likelihood.noise import Structure
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.effects import Effect
from grounded.effects.family import coupled
from grounded.effects.joint import added_inertia
from grounded.frozen import Array

STICKING = (0.03, 0.2)  # of an input's peak: dry frictions from which all joints start
MANY = 3  # joints, and effects, from which a search that adds one at a time may not get there
AGAIN = 8  # iterations after an effect was taken out or added
BEYOND = 4  # effects that are added at most to those of the joints
LATE = ("delay", "first_order_lag")  # what motors on one bus, of one kind, have in common
OWN = 0.3  # of a joint's own inertia: what is added at the start


def joint_model(search: HypothesisSearch) -> Fitted | None:
    """The likeliest hypothesis with all that joints may have, less what it can spare.

    All that is fitted is added to the search. Returns None where fewer than MANY joints
    share an inertia (of a simulator, which is slow, two), one effect is likelier, or fewer than
    MANY effects are needed.
    """
    joints = _joints(search)
    if len(joints) < (2 if simulated(search.data.model) else MANY):
        return None
    found = search.refined(_starts(search, joints), TO_THE_TOP, rivals=True)
    best = max(found, key=search.score, default=None)
    if best is None:
        return None
    best = _coloured(search, best)
    if any(search.score(best) < search.score(single) for single in search.of_size(1)[:1]):
        return None
    best = _spared(search, best)
    if len(best.hypothesis.effects) < MANY:
        return None  # one after the other, they are found too
    if not simulated(search.data.model):
        tune(search, [best])
        best = max(search.of_size(len(best.hypothesis.effects)), key=search.score)
    best = _completed(search, best, len(best.hypothesis.effects) + BEYOND)
    return _coloured(search, shared(search, best))


def _joints(search: HypothesisSearch) -> list[tuple[Effect, Effect]]:
    """Friction and inertia of each joint whose inertia is coupled with others'."""
    candidates = {e.name: e for e in search.candidates}
    inertias = [e for e in search.candidates if e.family.name == added_inertia.name]
    found = []
    for inertia in inertias:
        if (friction := search.joints.get(coupled(inertia.site)[1])) is not None:
            found.append((candidates.get(friction.name, friction), inertia))
    return found


def _starts(search: HypothesisSearch, joints: Sequence[tuple[Effect, Effect]]) -> list[Start]:
    """All joints with little and with much friction, parameters free or not, with a lag or none."""
    data = search.data
    bare, spreads = Hypothesis(), [0.0]
    if param_scale(data.model).any():
        spreads.append(CRUDE)
    own = [1 / max(push(inertia), 1e-12) for _, inertia in joints]  # effort over acceleration
    starts = []
    together = [e for e in search.candidates if e.family.name == LATE[1]]
    together = [e for e in together if len(e.site.targets) == data.model.m]
    for part, spread, late in product(STICKING, spreads, [None, *together]):
        h = Hypothesis(shift=np.zeros(data.model.system.k), spread=spread) if spread else bare
        h = h if late is None else h.plus(late, {late.free[0].name: 2 * data.dt})
        for (friction, inertia), size in zip(joints, own, strict=True):
            dry = part * data.scales.peak(coupled(friction.site)[0])
            h = h.plus(friction, {q.name: dry * (q.name == "c") for q in friction.free})
            h = h.plus(inertia, {"J": OWN * size})
        starts.append(search.fresh(h))
    return starts


def _coloured(search: HypothesisSearch, fit: Fitted) -> Fitted:
    """The fit, or the same under noise of another correlation time, where that is likelier."""
    starts = [
        (fit.hypothesis, fit.noise.allowing(Structure(tau), search.data.dt), fit.track)
        for tau in search.taus
        if tau != fit.noise.structure.tau
    ]
    return max([fit, *search.refined(starts, AGAIN)], key=search.score)


def _spared(search: HypothesisSearch, fit: Fitted) -> Fitted:
    """Without the effects that evidence does not ask for, the least needed first."""
    while fit.hypothesis.effects:
        less = _less(search, fit, int(_losses(search, fit).argmin()))
        if less is fit or search.score(less) < search.score(fit) - CLAIM:
            return fit
        fit = less
    return fit


def _losses(search: HypothesisSearch, fit: Fitted) -> Array:
    """About what evidence would lose without each effect, by Wald's test [nats], (effects,)."""
    h, covariance, at = fit.hypothesis, fit.covariance, 0
    found = []
    for effect, values in h.pairs:
        own = slice(at, at + len(effect.free))
        theta, at = h.theta[own], own.stop
        nats = 0.5 * float(theta @ np.linalg.pinv(covariance[own, own]) @ theta)
        found.append(search.tempering.factor * nats - search.price(effect, values))
    return np.array(found)


def _less(search: HypothesisSearch, fit: Fitted, index: int) -> Fitted:
    """The fit without one of its effects, all the rest fitted again; the fit where none can be."""
    start = fit.hypothesis.minus(fit.hypothesis.names[index])
    found = search.refined([(start, fit.noise, fit.track)], AGAIN)
    return found[0] if found else fit


def shared(search: HypothesisSearch, fit: Fitted) -> Fitted:
    """With one delay, or one lag, of all inputs in the place of those of some, where that pays."""
    rest = fit.hypothesis
    late = [(e, v) for e, v in rest.pairs if e.family.name in LATE]
    if not late:
        return fit
    for one, _ in late:
        rest = rest.minus(one.name)
    size = max(max(v.values()) for _, v in late)
    starts = [
        (rest.plus(effect, {effect.free[0].name: size}), fit.noise, fit.track)
        for effect in search.candidates
        if effect.family.name in LATE and len(effect.site.targets) == search.data.model.m
    ]
    return max([fit, *search.refined(starts, TO_THE_TOP)], key=search.score)


def _completed(search: HypothesisSearch, fit: Fitted, most: int) -> Fitted:
    """With what the joints alone don't do: a lag of all motors, one that is weaker."""
    while len(fit.hypothesis.effects) < most:
        further = search.extended(fit, iterations=AGAIN, late=False)
        best = max(further, key=search.score, default=fit)
        best = max(search.refined([best], TO_THE_TOP), key=search.score, default=best)
        if search.score(best) < search.score(fit) + CLAIM:
            return fit
        fit = _spared(search, best)
    return fit
