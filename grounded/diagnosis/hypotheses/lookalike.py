"""Effects that these trials, or no trials, tell apart from a claimed one.

**Look-alikes** produce nearly the same signal in these trials. Evidence may come from a few
moments: a dead zone and a dry friction are the same constant force while the car rolls, and differ
only where it stands. So in addition to ties (explanations within a few nats), the look-alikes of
each claimed effect are compared by their signals. The signal of an effect is

    s = whitened (f with the effect - f without it)

with the part that the other effects can absorb projected out, at the calibrated parameters. A
candidate whose best values reproduce most of |s|^2 is named with that share, whatever its evidence.

**Twins** equal it with other values of free parameters: (c - w)/0.137 - 0.97 w is
(0.88 c - w)/0.121. The search gives up losing hypotheses before they converge, and often fits them
under another noise. So each look-alike is put in its effect's place, starting from the noise and
the shifts of the best fit, and fitted to convergence before ties are decided (`swap`). Twins still
differ by some nats because of the time discretisation: half of a friction acts before a step and
half after it, while a gain acts during the whole step. So two effects whose rates are equal at all
states and inputs, and which predict equally well, tie whatever their evidence (`Claims.rivals`),
and no trial is asked to tell them apart.

**One clock.** If all sensors of the part that some inputs drive are delayed by d, y(t) = x(t - d),
then x' = f(x, u) becomes y' = f(y, u(t - d)), which are the equations for commands delayed by d. No
run can distinguish the two, unless the same clock stamps a command and its response.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from grounded import places
from grounded.diagnosis.hypotheses.leftover import filter_of
from grounded.diagnosis.hypotheses.scan import scan_candidates
from grounded.diagnosis.hypotheses.search import CRUDE, TO_THE_TOP, HypothesisSearch
from grounded.diagnosis.levels import ROUNDING
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.delays import delays_of
from grounded.diagnosis.likelihood.fitted import Fitted, calibrated
from grounded.diagnosis.likelihood.hypothesis import Hypothesis, param_scale, rates_of
from grounded.diagnosis.likelihood.linearise import base_columns
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.diagnosis.parts import Likeness
from grounded.effects import (
    Effect,
    InputFamily,
    Library,
    ParamFamily,
    RateFamily,
    SensorFamily,
    one_friction,
)
from grounded.filter import kalman
from grounded.frozen import Array
from grounded.model import Model

NEARLY = 0.75  # share of an effect's signal from which a look-alike is named
IDENTICAL = 1e-6  # fraction of a slope's power by which two equivalent effects may differ
MOST = 3  # most look-alikes named per effect


def lookalikes(
    predictor: Predictor, fit: Fitted, candidates: Sequence[Effect]
) -> tuple[Likeness, ...]:
    """Return the look-alikes that reproduce nearly all of a claimed effect's signal, best first.

    Args:
        predictor: evaluates hypotheses on the data.
        fit: the fit with the claimed effects.
        candidates: effects that may be look-alikes.
    """
    found: list[Likeness] = []
    for effect in fit.hypothesis.effects:
        own = [c for c in candidates if related(effect, c) and c.name not in fit.hypothesis.names]
        if fit.hypothesis.spread > 0:
            own = [c for c in own if not isinstance(c.family, ParamFamily)]
        found += _likely(predictor, fit, effect, own)
    return tuple(found)


def related(one: Effect | None, other: Effect) -> bool:
    """Check whether one of two families lists the other among its look-alikes."""
    if one is None:
        return False
    a, b = one.family, other.family
    return b.name in a.lookalikes or a.name in b.lookalikes


def _likely(
    predictor: Predictor, fit: Fitted, effect: Effect, own: Sequence[Effect]
) -> list[Likeness]:
    """Return the candidates that reproduce more than NEARLY of an effect's signal, best first."""
    shares = _shares(predictor, fit, effect, own) if own else []
    likely = [Likeness(effect.name, c.name, s) for c, s in zip(own, shares, strict=True)]
    near = sorted((one for one in likely if one.share > NEARLY), key=lambda one: -one.share)
    return near[:MOST]


def _shares(
    predictor: Predictor, fit: Fitted, effect: Effect, own: Sequence[Effect]
) -> list[float]:
    """Return the share of an effect's signal that each candidate reproduces at its best values."""
    h, data = fit.hypothesis, predictor.data
    if h.shift is not None:
        moved = dict(zip(data.model.param_names, data.model.values + h.shift, strict=True))
        data = replace(data, model=data.model.with_values(moved))
        h = replace(h, shift=None, spread=0.0)
    predictor, without = Predictor(data), h.minus(effect.name)
    # all with the filter of the hypothesis without the effect, as its look-alikes are scanned
    gains = filter_of(predictor, replace(fit, hypothesis=without))
    delays = delays_of(without, data)
    x, model = fit.track[:-1], data.model
    bare, full = predictor.next(without, x), predictor.next(h, x)
    d = model.difference(bare, full)
    track = np.concatenate([fit.track[:1], full])
    r = np.zeros_like(track) + predictor.offset(h, track) - predictor.offset(without, track)
    r = r if delays is None else delays.aligned(r)
    signal = kalman.innovations(gains, d[..., None], r[..., None])[0][..., 0]
    other = replace(fit, hypothesis=without, white=signal)
    columns, of_log = base_columns(predictor, other)
    W = np.zeros((signal.size, columns.shape[-1]))
    if W.shape[1]:
        W = kalman.innovations(gains, columns, of_log)[0].reshape(W.shape)
    other = replace(other, gram=(W.T @ W)[None], score=np.zeros((1, W.shape[1])))
    flat = signal.reshape(-1)
    taken = W.T @ flat
    power = 0.5 * float(flat @ flat - taken @ other.covariance @ taken)
    looks = scan_candidates(predictor, other, own)
    return [float(np.clip(look.gain / max(power, 1e-12), 0.0, 1.0)) for look in looks]


# -- twins
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

    Either may be a parameter of the model itself. Tested at random points, every state and input
    drawn independently: the rate that the one adds must be a linear combination of the other's and
    of the parameters' slopes. Only for effects with one value and no memory.

    What the parameters can do alone says nothing of the other effect: if one parameter scales each
    input and another one is each friction, any two of these effects would be one thing.
    """
    data = predictor.data
    if not (_at_once(one) and _at_once(other)):
        return False
    rng = np.random.default_rng(0)
    low, high = (f(data.filled, axis=0) for f in (np.min, np.max))
    least, most = (f(data.commands, axis=(0, 1)) for f in (np.min, np.max))
    apart = np.maximum(most - least, 1e-9)
    y = rng.uniform(low, high, (SAMPLES, data.model.n))
    u = rng.uniform(least - apart, most + apart, (SAMPLES, data.model.m))
    size = np.where(high > low, high - low, 1.0)  # of a state that is not logged: any
    scale, names = param_scale(data.model), data.model.param_names

    def slope(effect: Effect) -> Array:
        (q,) = effect.free
        side = SIDE
        if isinstance(effect.family, ParamFamily):
            side *= float(scale[names.index(effect.site.target)]) or 1.0
        ends = (Hypothesis().plus(effect, {q.name: sign * side}) for sign in (1, -1))
        after, before = (_rate(predictor, end, y, u) for end in ends)
        return np.asarray((after - before) / size).ravel()

    own = {effect.site.target for effect in (one, other) if isinstance(effect.family, ParamFamily)}
    moved = (names[k] for k in free if names[k] not in own)
    shifts = [slope(Library().effect(f"parameter:{name}", data.model)) for name in moved]
    first, second = slope(one), slope(other)
    if not first.any() or not second.any():
        return False
    if _is_sum(first, [second]):
        return True
    return not any(_is_sum(s, shifts) for s in (first, second)) and _is_sum(
        first, [second, *shifts]
    )


def _is_sum(own: Array, others: Sequence[Array]) -> bool:
    """Check whether a slope is a linear combination of others."""
    if not others:
        return False
    columns = np.stack(others, axis=-1)
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    left = own - columns @ np.linalg.lstsq(columns, own, rcond=1e-9)[0]
    return float(left @ left) <= IDENTICAL * float(own @ own)


SAMPLES = 500  # random points at which two effects are compared


def _at_once(effect: Effect) -> bool:
    """Check whether an effect has one value, no memory, and vanishes at zero."""
    family = effect.family
    acts = isinstance(family, RateFamily | InputFamily | SensorFamily | ParamFamily)
    timed = getattr(family, "parts", 0) or getattr(family, "timed", False)
    return acts and not timed and len(effect.free) == 1 and not effect.free[0].grid


def _rate(predictor: Predictor, h: Hypothesis, y: Array, u: Array) -> Array:
    """Return the instantaneous rates of logs y (N, n) under inputs u (N, m), effects included.

    Those of a simulator, which has no instantaneous rates, are means over a step.
    """
    given, names = u.copy(), predictor.data.model.input_names
    for effect, values in predictor.acting(h):
        assert isinstance(effect.family, InputFamily)
        for name in effect.site.targets:
            j = names.index(name)
            given[:, j] = effect.family.effect(u[:, j], 0.0, values)
    x = y - predictor.standing(h, y)
    dt = predictor.data.dt * (1.0 if simulated(predictor.data.model) else MOMENT)
    own = (predictor.step(x, given, predictor.params(h), dt) - x) / dt
    rate = own + predictor.added_rate(rates_of(h), x, given, np.zeros(len(x)), predictor.named(own))
    return rate + (predictor.standing(h, x + dt * rate) - predictor.standing(h, x)) / dt


# -- one clock
FAMILIES = {"delay": "sensor_delay", "sensor_delay": "delay"}


def one_clock(
    model: Model, effects: Sequence[Effect], shown: Sequence[str], still: Collection[str] = ()
) -> tuple[Likeness, ...]:
    """Find delays that cover all inputs, or all sensors, of an independent part of a model.

    Args:
        model: its structure defines the parts.
        effects: the claimed effects.
        shown: names of states that have a sensor.
        still: inputs that never changed, whose delay makes no difference.

    Returns:
        Each such delay, and the equivalent one of the other side.
    """
    some = [e for e in effects if e.family.name in FAMILIES]
    part, found = _parts(model) if some else {}, list[Likeness]()
    moving = [name for name in model.input_names if name not in still]
    for effect in some:
        touched = {part[name] for name in effect.site.targets}
        inputs, states = ([n for n in some if part[n] in touched] for some in (moving, shown))
        side, other = (inputs, states) if effect.family.name == "delay" else (states, inputs)
        if {*effect.site.targets} == {*side} and other:
            like = f"{FAMILIES[effect.family.name]}:{'+'.join(other)}"
            found.append(Likeness(effect.name, like, 1.0))
    return tuple(found)


def _parts(model: Model) -> dict[str, int]:
    """Return the part that each state and input belongs to: those that are coupled."""
    from scipy.sparse.csgraph import connected_components

    dt = places.probe(model, 1e-2)
    f_x, f_u = model.system.linearise(*places.samples(model, 8), model.values, dt)
    slopes = np.abs(np.concatenate([f_x - np.eye(model.n), f_u], axis=-1)).max(axis=0)
    coupled = np.zeros(2 * (model.n + model.m,))
    coupled[: model.n] = slopes > ROUNDING * slopes.max()
    parts = connected_components(coupled, directed=False)[1].tolist()
    return dict(zip((*model.state_names, *model.input_names), parts, strict=True))
