"""Look-alikes swapped in: what does an effect's work as well once the parameters move.

Where parameters are calibrated beside the effects, or one is claimed, a look-alike and another
value of a parameter may be the effect: (c - w)/0.137 - 0.97 w is (0.88 c - w)/0.121. The search
stops refining what lost on its way, often under another noise. So each look-alike is put in its
effect's place, from the noise and the shifts of the best fit, and fitted to the end, before
anything ties.

Twins like these still differ by some nats: half a friction acts before a step and half after it, a
gain all through it. So two that are one thing at every moment, wherever the state and the input
are, and predict alike, tie whatever the evidence says (`Claims.rivals`).
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
from grounded.diagnosis.report import Likeness
from grounded.effects import Effect, InputFamily, ParamFamily, RateFamily, one_friction
from grounded.frozen import Array

MOMENT = 1e-5  # of a step: what a model's rate at one moment is taken over
SIDE = 1e-4  # of a unit or a parameter's scale: half of a difference quotient


def swap(search: HypothesisSearch, best: Fitted, alike: Sequence[Likeness]) -> None:
    """Fits look-alikes of the effects of a fit whose parameters move in their place, to the end.

    Args:
        search: which remembers the fits.
        best: what is claimed; where no parameter moves nothing is fitted.
        alike: look-alikes of its effects; what is known at its top is left as it is.
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
    """Where a look-alike in the place of its effect starts; nothing where it is at its top."""
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
    """The parameters that a hypothesis may set, as indices: calibrated ones, or those it blames."""
    if h.spread > 0:
        return [int(i) for i in calibrated(data)]
    blamed = [e.site.target for e in h.effects if isinstance(e.family, ParamFamily)]
    return [data.model.param_names.index(name) for name in blamed]


def twins(predictor: Predictor, one: Effect, other: Effect, free: Sequence[int]) -> bool:
    """Whether an effect is another one beside other values of some parameters (`moving`).

    Seen far from the trials, every state and input drawn by itself, the rate that the one adds is a
    sum of the other's and of what the parameters change, at every moment. Effects of one value each
    that act at once; a simulator's rates at a moment are not known.
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
    own, others = columns[0], np.stack(columns[1:], axis=-1)
    others = others / np.maximum(np.linalg.norm(others, axis=0), 1e-300)
    left = own - others @ np.linalg.lstsq(others, own, rcond=1e-9)[0]
    return bool(own.any()) and float(left @ left) < IDENTICAL * float(own @ own)


SAMPLES = 500  # states and inputs at which two effects are compared


def _at_once(effect: Effect) -> bool:
    """Whether an effect is one number that acts without memory and is absent at zero."""
    family = effect.family
    acts = isinstance(family, RateFamily | InputFamily) and not getattr(family, "parts", 0)
    timed = getattr(family, "timed", False)
    return acts and not timed and len(effect.free) == 1 and not effect.free[0].grid


def _rate(predictor: Predictor, h: Hypothesis, x: Array, u: Array) -> Array:
    """Rates of states x (N, n) under inputs u (N, m) at one moment, effects and all, (N, n)."""
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
