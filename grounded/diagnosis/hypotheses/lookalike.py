"""Effects that these trials, or no trials, tell apart from a claimed one.

**Look-alikes** produce nearly the same signal in these trials. Evidence may come from a few
moments: a dead zone and a dry friction are the same constant force while the car rolls, and differ
only where it stands. So in addition to ties (explanations within a few nats), a candidate is named
that by the scan would gain most of what a claimed effect gains, in its place.

**Twins** equal it with other values of free parameters: (c - w)/0.137 - 0.97 w is
(0.88 c - w)/0.121. The search gives up losing hypotheses before they converge, and often fits them
under another noise. So each look-alike is put in its effect's place, starting from the noise and
the shifts of the best fit, and fitted to convergence before ties are decided. Twins still
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
from grounded.diagnosis.hypotheses.scan import scan_candidates
from grounded.diagnosis.hypotheses.search import CRUDE, TO_THE_TOP, HypothesisSearch, Start
from grounded.diagnosis.levels import NATS, ROUNDING
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.fitted import Fitted, calibrated
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.effects import (
    Effect,
    InputFamily,
    Library,
    ParamFamily,
    RateFamily,
    SensorFamily,
    one_friction,
)
from grounded.frozen import Array
from grounded.model import Model

NEARLY = 0.75  # share of an effect's gain from which a look-alike is fitted
IDENTICAL = 1e-6  # fraction of a slope's power by which two equivalent effects may differ
MOST_LOOKALIKES = 3  # most look-alikes fitted per effect


Likeness = tuple[str, str]  # an effect, and a candidate that gains nearly what it gains


def lookalikes(search: HypothesisSearch, best: Fitted) -> tuple[Likeness, ...]:
    """Return the look-alikes of each effect of a fit, best first.

    If parameters are free, each is fitted in its effect's place, unless it already converged there.

    Args:
        search: has the candidates, and stores the fits.
        best: the fit with the claimed effects.
    """
    h, found, starts = best.hypothesis, list[Likeness](), list[Start]()
    for effect in h.effects:
        own = [c for c in search.candidates if related(effect, c) and c.name not in h.names]
        if h.spread > 0:
            own = [c for c in own if not isinstance(c.family, ParamFamily)]
        if not own:
            continue

        # what each would gain beside the other effects, as a share of what this one does
        rest, less = h.minus(effect.name), search.without(best, effect.name)
        whole, *looks = scan_candidates(search.predictor, less, [effect, *own])
        shares = [look.gain / max(whole.gain, NATS) for look in looks]
        near = sorted(zip(shares, looks, strict=True), key=lambda pair: -pair[0])[:MOST_LOOKALIKES]
        for share, look in near:
            if not (share > NEARLY and look.values):
                continue
            found.append((effect.name, look.effect.name))
            names = tuple(sorted((*rest.names, look.effect.name)))
            known = search.fits.get((best.noise.structure, h.spread, names))
            alike = any(one_friction(look.effect, other) for other in rest.effects)
            if not alike and (known is None or not known.settled):
                starts.append((rest.plus(look.effect, look.values), best.noise, best.track))
    if moving(search.data, h):
        fits = search.refined(starts, TO_THE_TOP)
        far = [fit for fit in fits if 0 < fit.hypothesis.spread < CRUDE and search.far(fit)]
        crude = [(replace(f.hypothesis, spread=CRUDE), f.noise, f.track) for f in far]
        search.refined(crude, TO_THE_TOP)
    return tuple(found)


def related(one: Effect | None, other: Effect) -> bool:
    """Check whether one of two families lists the other among its look-alikes."""
    if one is None:
        return False
    a, b = one.family, other.family
    return b.name in a.lookalikes or a.name in b.lookalikes


# -- twins
MOMENT = 1e-5  # fraction of a step over which an instantaneous rate is computed
SIDE = 1e-4  # half the finite-difference step, in units or a parameter's scale


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
    scale, names = data.model.spreads, data.model.param_names

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
    for effect, values in h.acting:
        assert isinstance(effect.family, InputFamily)
        for name in effect.site.targets:
            j = names.index(name)
            given[:, j] = effect.family.effect(u[:, j], 0.0, values)
    x = y - predictor.standing(h, y)
    dt = predictor.data.dt * (1.0 if simulated(predictor.data.model) else MOMENT)
    own = (predictor.step(x, given, predictor.params(h), dt) - x) / dt
    rate = own + predictor.added_rate(h.rates, x, given, np.zeros(len(x)), predictor.named(own))
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
            found.append((effect.name, like))
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
