"""Fits of look-alikes in place of a claimed effect, while parameters are free.

If parameters are calibrated beside the effects, or one is claimed, a look-alike with another value
of a parameter may equal the effect: (c - w)/0.137 - 0.97 w is (0.88 c - w)/0.121. The search gives
up losing hypotheses before they converge, and often fits them under another noise. So each
look-alike is put in its effect's place, starting from the noise and the shifts of the best fit, and
fitted to convergence before ties are decided.

Such twins still differ by some nats because of the time discretisation: half of a friction acts
before a step and half after it, while a gain acts during the whole step. So two effects whose rates
are equal at all states and inputs, and which predict equally well, tie whatever their evidence
(`Claims.rivals`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from grounded.diagnosis.hypotheses.lookalike import IDENTICAL
from grounded.diagnosis.hypotheses.scan import scan_candidates
from grounded.diagnosis.hypotheses.search import CRUDE, TO_THE_TOP, HypothesisSearch
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.fitted import Fitted, calibrated
from grounded.diagnosis.likelihood.hypothesis import Hypothesis, param_scale, rates_of
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.diagnosis.parts import Likeness
from grounded.effects import Effect, InputFamily, ParamFamily, RateFamily, one_friction
from grounded.frozen import Array

MOMENT = 1e-5  # fraction of a step over which an instantaneous rate is computed
SIDE = 1e-4  # half the finite-difference step, in units or a parameter's scale


def swap(search: HypothesisSearch, best: Fitted, alike: Sequence[Likeness]) -> None:
    """Fit look-alikes in place of the effects of a fit whose parameters are free.

    Args:
        search: stores the fits.
        best: the claimed fit; if none of its parameters is free, nothing is fitted.
        alike: look-alikes of its effects; those already converged are left as they are.
    """
    if not moving(search.data, best.hypothesis):
        return
    fits = search.refined(
        [start for one in alike for start in _start(search, best, one)], TO_THE_TOP
    )
    far = [fit for fit in fits if 0 < fit.hypothesis.spread < CRUDE and search.far(fit)]
    crude = [(replace(f.hypothesis, spread=CRUDE), f.noise, f.track) for f in far]
    search.refined(crude, TO_THE_TOP)


def _start(search: HypothesisSearch, best: Fitted, one: Likeness) -> list[tuple]:  # type: ignore[type-arg]
    """Return the start of a look-alike in place of its effect; none if it already converged."""
    names = tuple(sorted({*best.hypothesis.names} - {one.effect} | {one.like}))
    known = search.fits.get((best.noise.structure, best.hypothesis.spread, names))
    (effect,) = (e for e in search.candidates if e.name == one.like)
    rest = best.hypothesis.minus(one.effect)
    if (known is not None and known.settled) or any(one_friction(effect, e) for e in rest.effects):
        return []
    less = search.without(best, one.effect)
    (look,) = scan_candidates(search.predictor, less, [effect])
    return [(rest.plus(effect, look.values), best.noise, best.track)] if look.values else []


def moving(data: Data, h: Hypothesis) -> list[int]:
    """Return the indices of a hypothesis' free parameters: the calibrated or the blamed ones."""
    if h.spread > 0:
        return [int(i) for i in calibrated(data)]
    blamed = [e.site.target for e in h.effects if isinstance(e.family, ParamFamily)]
    return [data.model.param_names.index(name) for name in blamed]


def twins(predictor: Predictor, one: Effect, other: Effect, free: Sequence[int]) -> bool:
    """Check whether an effect equals another one combined with shifts of parameters (`moving`).

    Tested at random points, every state and input drawn independently: the rate that the one adds
    must be a linear combination of the other's and of the parameters' slopes. Only for effects with
    one value and no memory, and not for simulators, whose instantaneous rates are not known.

    What the parameters can do alone says nothing of the other effect: if one parameter scales each
    input and another one is each friction, any two of these effects would be one thing.
    """
    data, h = predictor.data, Hypothesis()
    if simulated(data.model) or not (_at_once(one) and _at_once(other)):
        return False
    rng = np.random.default_rng(0)
    low, high = (f(data.filled, axis=0) for f in (np.min, np.max))
    least, most = (f(data.commands, axis=(0, 1)) for f in (np.min, np.max))
    apart = np.maximum(most - least, 1e-9)
    x = rng.uniform(low, high, (SAMPLES, data.model.n))
    u = rng.uniform(least - apart, most + apart, (SAMPLES, data.model.m))
    size = np.maximum(high - low, 1e-12)

    def slope(up: Hypothesis, down: Hypothesis) -> Array:
        after, before = (_rate(predictor, end, x, u) for end in (up, down))
        return np.asarray((after - before) / size).ravel()

    columns = []
    for effect in (one, other):
        (q,) = effect.free
        columns.append(slope(*(h.plus(effect, {q.name: s * SIDE}) for s in (1, -1))))
    scale = param_scale(data.model)
    for index in free:
        moved = np.zeros(len(scale))
        moved[index] = SIDE * scale[index]
        columns.append(slope(replace(h, shift=moved), replace(h, shift=-moved)))
    first, second, *shifts = columns
    if any(_is_sum(effect, shifts) for effect in (first, second)):
        return False
    return bool(first.any()) and _is_sum(first, [second, *shifts])


def _is_sum(own: Array, others: Sequence[Array]) -> bool:
    """Check whether a slope is a linear combination of others."""
    if not others:
        return not own.any()
    columns = np.stack(others, axis=-1)
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    left = own - columns @ np.linalg.lstsq(columns, own, rcond=1e-9)[0]
    return float(left @ left) <= IDENTICAL * float(own @ own)


SAMPLES = 500  # random points at which two effects are compared


def _at_once(effect: Effect) -> bool:
    """Check whether an effect has one value, no memory, and vanishes at zero."""
    family = effect.family
    acts = isinstance(family, RateFamily | InputFamily) and not getattr(family, "parts", 0)
    timed = getattr(family, "timed", False)
    return acts and not timed and len(effect.free) == 1 and not effect.free[0].grid


def _rate(predictor: Predictor, h: Hypothesis, x: Array, u: Array) -> Array:
    """Return the instantaneous rates of states x (N, n) under inputs u (N, m), effects included."""
    given, names = u.copy(), predictor.data.model.input_names
    for effect, values in predictor.acting(h):
        assert isinstance(effect.family, InputFamily)
        for name in effect.site.targets:
            j = names.index(name)
            given[:, j] = effect.family.effect(u[:, j], 0.0, values)
    dt = MOMENT * predictor.data.dt
    own = (predictor.step(x, given, predictor.params(h), dt) - x) / dt
    time = np.zeros(len(x))
    return own + predictor.added_rate(rates_of(h), x, given, time, predictor.named(own))
