"""Backward elimination for an arm: friction and inertia of all joints at once, then removals.

If every joint of an arm differs from its model, the friction of a single joint makes no joint move
as logged. Each true effect alone gains little, and a common weak input of all joints is likelier,
so a search that adds one effect at a time never finds them. This search starts from the full model
of robot identification: every joint with dry and viscous friction and a rotor inertia. Effects
that do not pay by evidence are removed one by one; then others that do are added.

Source: Swevers, Verdonck & De Schutter, Dynamic Model Identification for Industrial Robots (2007).
Wald's test (values against their covariance) gives the order of the removals; the rest is fitted
again after each.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from grounded.diagnosis.hypotheses.search import (
    CRUDE,
    TO_THE_TOP,
    HypothesisSearch,
    Start,
)
from grounded.diagnosis.hypotheses.variations import LATE, varied
from grounded.diagnosis.levels import NATS
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.effects import Effect
from grounded.effects.drive import motion_of, push
from grounded.effects.family import coupled
from grounded.effects.joint import added_inertia
from grounded.frozen import Array

STICKING = (0.03, 0.2)  # initial dry frictions, as fractions of an input's peak
MANY_JOINTS = 3  # joints, and effects, above which adding one effect at a time may fail
CHANGED_ITERATIONS = 8  # iterations after an effect was removed or added
BEYOND = 4  # most effects added to those of the joints
OWN = 0.3  # initial added inertia, as a fraction of a joint's own


def joint_model(search: HypothesisSearch) -> Fitted | None:
    """Fit friction and inertia of all joints together, then remove what evidence does not need.

    All fits are added to the search.

    Returns:
        The best fit. None if fewer than MANY_JOINTS joints (two of a simulator, which is slow)
        share an inertia, if a single effect is likelier, or if fewer effects remain.
    """
    joints = _joints(search)
    if len(joints) < (2 if simulated(search.data.model) else MANY_JOINTS):
        return None
    found = search.refined(_starts(search, joints), TO_THE_TOP, rivals=True)
    best = max(found, key=search.score, default=None)
    if best is None:
        return None
    best = _coloured(search, best)
    if any(search.score(best) < search.score(single) for single in search.of_size(1)[:1]):
        return None
    best = _spared(search, best)
    if len(best.hypothesis.effects) < MANY_JOINTS:
        return None  # adding one at a time finds them, too
    if not simulated(search.data.model):
        best = max(search.of_size(len(best.hypothesis.effects)), key=search.score)
    best = _completed(search, best, len(best.hypothesis.effects) + BEYOND)
    return _coloured(search, varied(search, best))


def _joints(search: HypothesisSearch) -> list[tuple[Effect, Effect]]:
    """Return friction and inertia of each joint whose inertia is coupled with other joints."""
    candidates = {e.name: e for e in search.candidates}
    inertias = [e for e in search.candidates if e.family.name == added_inertia.name]
    found = []
    for inertia in inertias:
        if (friction := search.joints.get(motion_of(inertia))) is not None:
            found.append((candidates.get(friction.name, friction), inertia))
    return found


def _starts(search: HypothesisSearch, joints: Sequence[tuple[Effect, Effect]]) -> list[Start]:
    """Return starts with little or much friction, free or exact parameters, a lag or none."""
    data = search.data
    bare, spreads = Hypothesis(), [0.0]
    if data.model.spreads.any():
        spreads.append(CRUDE)
    own = [
        1 / max(push(inertia.site.model, inertia.site.joined), 1e-12) for _, inertia in joints
    ]  # effort over acceleration
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
    """Return the likeliest of the fit and the same under noise of other correlation times."""
    found = search.coloured(fit.hypothesis, fit.noise, fit.track, iterations=CHANGED_ITERATIONS)
    return max([fit, *found], key=search.score)


def _spared(search: HypothesisSearch, fit: Fitted) -> Fitted:
    """Remove effects that do not pay, the least needed first."""
    while fit.hypothesis.effects:
        less = _less(search, fit, int(_losses(search, fit).argmin()))
        if less is fit or search.score(less) < search.score(fit) - NATS:
            return fit
        fit = less
    return fit


def _losses(search: HypothesisSearch, fit: Fitted) -> Array:
    """Return the approximate loss of evidence without each effect, by Wald's test [nats]."""
    h, covariance, at = fit.hypothesis, fit.covariance, 0
    found = []
    for effect, values in h.pairs:
        own = slice(at, at + len(effect.free))
        theta, at = h.theta[own], own.stop
        nats = 0.5 * float(theta @ np.linalg.pinv(covariance[own, own]) @ theta)
        found.append(search.tempering.factor * nats - search.price(effect, values))
    return np.array(found)


def _less(search: HypothesisSearch, fit: Fitted, index: int) -> Fitted:
    """Refit without one effect; return the fit unchanged if that can't be filtered."""
    start = fit.hypothesis.minus(fit.hypothesis.names[index])
    found = search.refined([(start, fit.noise, fit.track)], CHANGED_ITERATIONS)
    return found[0] if found else fit


def _completed(search: HypothesisSearch, fit: Fitted, most: int) -> Fitted:
    """Add effects beside those of the joints, such as a lag of all motors, while evidence rises."""
    while len(fit.hypothesis.effects) < most:
        further = search.extended(fit, iterations=CHANGED_ITERATIONS, late=False)
        best = max(further, key=search.score, default=fit)
        best = max(search.refined([best], TO_THE_TOP), key=search.score, default=best)
        if search.score(best) < search.score(fit) + NATS:
            return fit
        fit = _spared(search, best)
    return fit
