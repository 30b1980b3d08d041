"""Plain dry friction of a joint, fitted as a rival of its other frictions.

A load-dependent friction, a Coulomb friction beside a stiction, and a joint friction whose viscous
part is zero, or is that of all joints, all contain the plain friction of the joint as a special
case with a lower price. If the joint's inertia is constant, the candidate for that friction is
`coulomb_friction`. It is an added rate and can't hold a joint at rest, so any richer friction that
can would win for that reason alone. Therefore the joint's own friction is fitted as well, in place
of a richer one (`plainer`) and of the Coulomb friction itself (`holding`): a motor that a knob
turns to and fro is at rest between two turns, and without a friction that holds it there its time
constant was 5 % off.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from grounded import places
from grounded.diagnosis.hypotheses.search import TO_THE_TOP, HypothesisSearch
from grounded.diagnosis.hypotheses.tuning import tune
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.noise import Structure
from grounded.diagnosis.likelihood.refine import refine
from grounded.effects import Effect
from grounded.effects.drive import motion_of, speed
from grounded.effects.family import coupled
from grounded.effects.joint import joint_friction, load_friction

CLEARLY = 8.0  # nats by which a friction that holds a joint must be likelier than one that does not


def plainer(search: HypothesisSearch, fit: Fitted) -> list[Fitted]:
    """Return the fits of the plainer forms of a fit, under noise of the same structure."""
    found = []
    for h in plain_forms(search, fit.hypothesis):
        key = _key(replace(fit, hypothesis=h))
        if key not in search.fits or {*h.names} == {*fit.hypothesis.names}:
            # the speed over which another law builds up is not that of this one
            tune(search, search.refined([(h, fit.noise, fit.track)], TO_THE_TOP))
        plain_fit = search.fits.get(key)
        if plain_fit is not None and _numbers(plain_fit) < _numbers(fit):
            found.append(plain_fit)
    return found


def plain_friction(search: HypothesisSearch, fit: Fitted) -> Fitted:
    """Return a fit with the plain friction of its joints in place of other laws, where likelier.

    A law with more values may have won only because it holds the joint. Beside it, what its further
    values leave is sought, and not what the joint's own friction leaves.
    """
    found = max((holding(search, fit), *plainer(search, fit)), key=search.score)
    return plain_friction(search, found) if search.score(found) > search.score(fit) else fit


def holding(search: HypothesisSearch, fit: Fitted) -> Fitted:
    """Return a fit with the joint's own friction in place of a Coulomb friction, if far likelier.

    The two are one friction while the joint moves; a fit that isn't clearly likelier is not kept,
    nor is one with a viscous part, which is another cause: of a linear axis, far above its noise,
    that was the likeliest set and predicted worst.
    """
    for effect, values in fit.hypothesis.pairs:
        joint = search.joints.get(motion_of(effect))
        if effect.family.name == "coulomb_friction" and joint is not None and len(joint.free) == 1:
            h = fit.hypothesis.minus(effect.name).plus(joint, _of_rate(joint, values))
            found = refine(search.predictor, [(h, fit.noise, fit.track)], iterations=TO_THE_TOP)
            if found and search.score(found[0]) > search.score(fit) + CLEARLY:
                search.keep(found)
                tune(search, found)
                fit = search.latest(found[0])
    return fit


def _numbers(fit: Fitted) -> int:
    """Return the number of effects and values, since of two fits of one name only one is kept."""
    return len(fit.hypothesis.effects) + len(fit.hypothesis.theta)


def _key(fit: Fitted) -> tuple[Structure, float, tuple[str, ...]]:
    h = fit.hypothesis
    return fit.noise.structure, h.spread, tuple(sorted(h.names))


def plain_forms(search: HypothesisSearch, h: Hypothesis) -> Iterator[Hypothesis]:
    """Yield the hypothesis with each dry friction replaced by its plain form."""
    by_family = {(e.family.name, motion_of(e)): (e, v) for e, v in h.pairs}
    for (family, motion), (effect, values) in by_family.items():
        joint = search.joints.get(motion)
        if family == load_friction.name and joint is not None:
            yield h.minus(effect.name).plus(joint, _of_joint(joint, values))
        stiction = by_family.get(("stiction", motion))
        if family == "coulomb_friction" and stiction is not None and joint is not None:
            rest = h.minus(effect.name).minus(stiction[0].name)
            yield rest.plus(joint, _of_rate(joint, values))
        if values.get("b") == 0 and _viscous(effect):
            yield _dry(h, [effect])
    if len(several := [effect for effect in h.effects if _viscous(effect)]) > 1:
        yield _dry(h, several)


def _viscous(effect: Effect) -> bool:
    """Return whether an effect is a joint's friction whose viscous part is free."""
    return effect.family.name == joint_friction.name and "b" not in effect.fixed


def _dry(h: Hypothesis, effects: Sequence[Effect]) -> Hypothesis:
    """Return a hypothesis in which some joint frictions have no viscous part.

    That of one wheel is a cause; of both wheels, it may be what the gain and the time constants of
    the model say as well.
    """
    values = dict(zip(h.names, h.values, strict=True))
    for effect in effects:
        some = (replace(q, fixed=q.fixed or q.name == "b") for q in effect.quantities)
        dry = replace(effect, quantities=tuple(some))
        h = h.minus(effect.name).plus(dry, {**values[effect.name], "b": 0.0})
    return h


def _of_rate(joint: Effect, values: Mapping[str, float]) -> dict[str, float]:
    """Return the values of a joint's friction that brakes it as much as a Coulomb friction."""
    return {"c": values["c"] / push(joint), "b": 0.0}


def _of_joint(joint: Effect, values: Mapping[str, float]) -> dict[str, float]:
    """Return the values of a load-dependent friction without the dependence on the load."""
    return {q.name: float(values[q.name]) for q in joint.quantities}


def push(joint: Effect) -> float:
    """Return the median acceleration per unit of the joint's input."""
    model, (tau, _) = joint.site.model, coupled(joint.site)
    dt, (x, u) = places.probe(model, 1e-5), places.samples(model, 8)
    _, f_u = model.system.linearise(x, u, model.values, dt)
    by = speed(
        joint, dict(zip(model.state_names, f_u[..., model.input_names.index(tau)].T, strict=True))
    )
    return float(np.median(by)) / dt
