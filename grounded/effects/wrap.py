"""Adding an effect to a model: the wrapped model is again a plain model, with more parameters.

One control step of the wrapped model, for commands held over the step:

    u_eff  = effect(u, z, t)                      input and memory families (and a lag's `lead`)
    f      = f(s, u_eff - loss(s, f))             losses to a joint's friction, solved (`joint`)
    own    = (f(s, u_eff) - s) / dt               the model's own mean rate over the step
    s1     = f(s + dt/2 rate(s), u_eff)           half of an added rate before the step ...
    s2     = s1 + dt/2 rate(s1)
    s+     = s1 + dt/2 rate(s2)                   ... and half after it (Strang): second order in dt
    s+     = s + h (own + rate(s))                families that limit a rate, h = dt / parts
    s+     = V_c(f(V_-c(s))) + dt c               a medium that moves with c (`medium`)
    y+     = measure(s+),  s = recover(y)         sensor families

Several rates are summed and all see the same `own`, in whatever order they were wrapped: `own`
never contains another added rate. Limits act between the added halves.

The result is a `step` model in plain NumPy, so that it is traced and compiled if the original was.
Memory (a lag's output, a queue, a clock) becomes further states, which are functions of the
commands and the measured states (`memory`). `wrapping_order` gives the order of several effects.
Effects on the motion go inside delayed sensors, a medium and input effects that the model already
has (`_inside`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from grounded.checks import unknown
from grounded.compile.names import Named
from grounded.effects.actuator import delay
from grounded.effects.family import (
    Effect,
    InputFamily,
    LossFamily,
    MediumFamily,
    MemoryFamily,
    ParamFamily,
    Quantity,
    RateFamily,
    Scales,
    SensorDelayFamily,
    SensorFamily,
    SensorLagFamily,
    Site,
    Values,
    braked,
)
from grounded.effects.losses import memory_name, remembered, step_with
from grounded.effects.medium import over_ground, through_it
from grounded.effects.plain_step import (
    Around,
    Step,
    around,
    joined,
    own_state,
    param_name,
    plain_step,
    quantities_of,
)
from grounded.effects.sensed import behind_logs, late_step, sensor_step
from grounded.model import Model, Param
from grounded.places import integrated, partner


def wrap(effect: Effect, values: Mapping[str, float], dt: float) -> Model:
    """Return the model with the effect: new parameters `family_target_c`, memory states if needed.

    Args:
        effect: built for the model that it will change (`Library.effect`).
        values: the effect's quantities; fixed ones may be omitted.
        dt: control step [s], which sets the length of a queue.
    """
    model, family = effect.site.model, effect.family
    whole = effect.complete(values)
    if isinstance(family, ParamFamily):
        name = effect.site.target
        return model.with_values({name: model.params[name].value + whole["d"]})
    outside = around(model)
    moves = isinstance(family, LossFamily | MediumFamily | RateFamily)
    if moves and outside and not isinstance(outside.effects[-1].family, LossFamily | RateFamily):
        return _inside(outside, effect, values, dt)
    sized = any(whole[q.name] for q in effect.quantities if not q.fixed)
    added = {
        param_name(effect.name, q.name): _param(q, whole[q.name], sized) for q in effect.quantities
    }
    make = {
        InputFamily: _input_step,
        LossFamily: _loss_step,
        MemoryFamily: _memory_step,
        RateFamily: _rate_step,
        MediumFamily: _medium_step,
        SensorFamily: sensor_step,
        SensorDelayFamily: late_step,
        SensorLagFamily: late_step,
    }
    build = next((build for kind, build in make.items() if isinstance(family, kind)), None)
    if build is None:
        raise unknown("effect that can be adopted", effect.name, ())
    step, memory = build(effect, whole, dt)
    vars(step)["timestep"] = getattr(model.step, "timestep", 0.0)
    beside = joined(model, LossFamily if isinstance(family, LossFamily) else RateFamily)
    inner, others = beside if isinstance(family, LossFamily | RateFamily) else (model, ())
    vars(step)["around"] = outer = Around(inner, (*others, effect), whole, dt)
    if outer.of_inputs and (late := behind_logs(model)):
        vars(step)["behind"] = late.lifted(model)
    written = model.step or model.derivative
    vars(step)["__wrapped__"] = getattr(written, "__wrapped__", written)  # `where`: the user's
    return Model(
        states={**model.states, **memory},
        inputs=model.inputs,
        params={**model.params, **added},
        angles=model.angles,
        roles=model.roles,
        step=step,
        name=f"{model.name} with {effect.name}",
    )


def late_by(model: Model, late: Mapping[str, float], dt: float) -> Model:
    """Return a model whose inputs arrive `late` by a part of a step: {input: time below dt [s]}.

    The step is made in parts, before and after each of them arrives. So what bends an input (a dead
    zone) or has a memory (a lag) gets what was sent, not a mean of two commands.
    """
    if not late:
        return model
    one = replace(delay, depth=lambda values, dt: 1)
    each = tuple(Quantity(name, "s", fixed=True, start=by) for name, by in late.items())
    return wrap(Effect(one, Site(model, tuple(late), Scales()), each), dict(late), dt)


def _inside(outside: Around, effect: Effect, values: Mapping[str, float], dt: float) -> Model:
    """Return a model with an effect on the motion inside its outermost effect.

    A friction acts on the true velocity, not on its delayed log; a hull's drag through the water.
    """
    model, outer = effect.site.model, outside.effects[-1]
    inner = outside.inner
    inner = replace(inner, params={name: model.params[name] for name in inner.params})
    grown = wrap(replace(effect, site=replace(effect.site, model=inner)), values, dt)
    again = replace(outer, site=replace(outer.site, model=grown))
    whole = wrap(again, outside.values, outside.dt)
    params = {name: model.params.get(name, param) for name, param in whole.params.items()}
    name = f"{model.name} with {effect.name}"
    return replace(whole, params=params, name=name)


ADOPTED_SPREAD = 0.5  # prior standard deviation of an adopted quantity, relative to its value


def _param(quantity: Quantity, value: float, constant_at_zero: bool) -> Param:
    """Return a quantity as a parameter of the wrapped model.

    One that is 0 beside others was not shown by the data, and becomes a constant.
    """
    fixed = quantity.fixed or (value == 0 and constant_at_zero)
    if fixed:
        return Param(value, quantity.unit, value, value)
    low = None if not np.isfinite(quantity.low) else min(float(quantity.low), value)
    high = None if not np.isfinite(quantity.high) else max(float(quantity.high), value)
    return Param(value, quantity.unit, low, high, ADOPTED_SPREAD * abs(value) or None)


def _replaced(model: Model, a: Any, target: Mapping[str, Any]) -> Named:
    return Named("input", model.input_names, [target.get(n, a[n]) for n in model.input_names])


def _clock(effect: Effect) -> str:
    return f"{effect.family.name}_clock"


def _input_step(effect: Effect, whole: Values, dt: float) -> tuple[Step, dict[str, str]]:
    model, family = effect.site.model, effect.family
    assert isinstance(family, InputFamily)
    base, clock = plain_step(model), _clock(effect)
    timed = family.timed

    def step(s: Any, a: Any, p: Any, dt: Any) -> dict[str, Any]:
        c = quantities_of(effect, p)
        t = s[clock] if timed else 0.0
        u = {n: family.effect(a[n], t, c) for n in effect.site.targets}
        after = base(own_state(model, s), _replaced(model, a, u), p, dt)
        return {**after, clock: s[clock] + dt} if timed else after

    return step, {clock: "s"} if timed else {}


def _in_parts(effect: Effect, whole: Values, dt: float) -> tuple[Step, dict[str, str]]:
    """Return a step made in parts, since each input arrives a part of it late (`late_by`)."""
    model, late = effect.site.model, behind_logs(effect.site.model)
    base, names = plain_step(model), effect.site.targets
    by = {n: whole[n] / dt for n in names}
    memory = {n: f"{n}_{effect.family.name}_1" for n in names}
    slow = getattr(model.step, "timestep", 0.0)  # a simulator makes whole steps only
    ends = (*(() if slow else sorted(set(by.values()))), 1.0)

    def step(s: Any, a: Any, p: Any, dt: Any) -> dict[str, Any]:
        start, at = own_state(model, s), 0.0
        now: Any = start
        for end in ends:
            u = {n: s[memory[n]] if end <= by[n] else a[n] for n in names}
            if slow:
                u = {n: (1 - by[n]) * a[n] + by[n] * s[memory[n]] for n in names}
            after = base(now, _replaced(model, a, u), p, (end - at) * dt)
            now, at = Named("state", model.state_names, [after[n] for n in model.state_names]), end
        after = dict(late.log(start, now, p, dt)) if late else after
        return {**after, **{memory[n]: a[n] for n in names}}

    return step, {memory[n]: model.inputs[n] for n in names}


def _memory_step(effect: Effect, whole: Values, dt: float) -> tuple[Step, dict[str, str]]:
    model, family = effect.site.model, effect.family
    assert isinstance(family, MemoryFamily)
    if {*whole} == {*effect.site.targets}:
        return _in_parts(effect, whole, dt)
    base, depth, lead = plain_step(model), family.depth(whole, dt), family.lead
    # a rate limit's lead has kinks that would hinder plans, and changes its estimate by 1e-4
    positions = integrated(model) if lead is not None and family.linear else {}
    # without added rates and losses, which leads of inputs hardly change
    inner, _ = joined(joined(model, RateFamily)[0], LossFamily)
    bare = plain_step(inner)
    names = {n: [f"{n}_{family.name}_{i + 1}" for i in range(depth)] for n in effect.site.targets}

    def step(s: Any, a: Any, p: Any, dt: Any) -> dict[str, Any]:
        c, u = quantities_of(effect, p), dict[str, Any]()
        kept: dict[str, Any] = {}
        for n, memory in names.items():
            u[n], later = family.advance(a[n], tuple(s[z] for z in memory), c, dt)
            kept.update(zip(memory, later, strict=True))
        start = own_state(model, s)
        after = base(start, _replaced(model, a, u), p, dt)
        if positions and lead is not None:
            led = {n: u[n] + lead(a[n], s[memory[0]], c, dt) for n, memory in names.items()}
            # a plain model has made this step already
            less = after if inner is model else bare(start, _replaced(model, a, u), p, dt)
            more = bare(start, _replaced(model, a, led), p, dt)
            by = {q: k * dt * (more[w] - less[w]) for q, (w, k) in positions.items()}
            after = after | {q: after[q] + by[q] for q in by}
        return {**after, **kept}

    return step, {z: model.inputs[n] for n, memory in names.items() for z in memory}


def _loss_step(effect: Effect, whole: Values, dt: float) -> tuple[Step, dict[str, str]]:
    """Add a loss, solved together with those that the model already has."""
    model = effect.site.model
    inner, others = joined(model, LossFamily)
    bare = getattr(inner.step, "bare", inner)
    bases, effects, moved = (
        [plain_step(inner), plain_step(bare)],
        (*others, effect),
        integrated(bare),
    )

    def step(s: Any, a: Any, p: Any, dt: Any) -> dict[str, Any]:
        start, given = own_state(inner, s), _replaced(inner, a, {})
        pairs = _remembering(effects, s, p)
        step, held = ((lambda u, base=base: base(start, u, p, dt)) for base in bases)
        return step_with(pairs, start, given, dt, (step, held), moved)

    memory = _loss(effect).memory(effect.site)
    return step, {memory_name(effect, z): unit for z, unit in memory.items()}


def _remembering(effects: Sequence[Effect], s: Any, p: Any) -> list[tuple[Effect, dict[str, Any]]]:
    """Return losses with their quantities and memories."""
    each = ((e, quantities_of(e, p), _loss(e).memory(e.site)) for e in effects)
    return [(e, c | {z: s[memory_name(e, z)] for z in names}) for e, c, names in each]


def _loss(effect: Effect) -> LossFamily:
    assert isinstance(effect.family, LossFamily)
    return effect.family


def _rate_step(effect: Effect, whole: Values, dt: float) -> tuple[Step, dict[str, str]]:
    """Add a rate or a limit to those that the model already has."""
    model = effect.site.model
    inner, others = joined(model, RateFamily)
    return _joint_step(inner, (*others, effect)), dict.fromkeys(_clocks([effect]), "s")


def _joint_step(model: Model, effects: tuple[Effect, ...]) -> Step:
    """Return a step with all rates, each of which sees the model's own rate without the others.

    These are the equations of the diagnosis, `Predictor.advance`.
    """
    base, instant, clocks = plain_step(model), _instant(model), _clocks(effects)
    bare = getattr(model.step, "bare", model)
    limits = [e for e in effects if _family(e).parts]
    rates = [e for e in effects if not _family(e).parts]
    soft, dry = ([e for e in rates if _family(e).dry == one] for one in (False, True))
    needs_own = any(_family(e).needs_own for e in rates)
    tied = {n: k for n in bare.state_names if (k := partner(bare, n))}
    losing = joined(model, LossFamily)[1]

    def step(s: Any, a: Any, p: Any, dt: Any) -> dict[str, Any]:
        start, now = own_state(model, s), {z: s[z] for z in clocks}
        then = {z: s[z] + dt for z in clocks}
        own = _mean_rate(start, base(start, a, p, dt), dt) if needs_own else {}
        state = _kicked(start, _added(rates, start, a, own, now, p, dt), dt)
        after, own = _through(limits, base, state, a, p, dt, now)  # own: mean over this step
        last = _added(rates, after, a, own, then, p, dt)
        if soft:
            there = _kicked(after, last, dt)
            last = _added(soft, there, a, own, then, p, dt)
            for n, rate in _added(dry, after, a, own, then, p, dt).items():
                last[n] = last[n] + rate if n in last else rate
        final = _kicked(after, last, dt)
        result = dict(final) | remembered(_remembering(losing, start, p), start, final, a, dt)
        for n, k in tied.items():  # a carried heading rate is the heading's, effects included
            first, last = instant(start, a, p, dt), instant(final, a, p, dt)
            before = _added(effects, start, a, first, now, p, dt).get(n, 0.0)
            later = _added(effects, final, a, last, then, p, dt).get(n, 0.0)
            result[k] = s[k] + (last[n] - first[n]) + later - before
        return {**result, **then}

    return step


def _family(effect: Effect) -> RateFamily:
    assert isinstance(effect.family, RateFamily)
    return effect.family


def _clocks(effects: Sequence[Effect]) -> list[str]:
    return [_clock(e) for e in effects if _family(e).timed]


def _instant(model: Model) -> Step:
    """Return the model's instantaneous rates: its derivative, or the mean over a short step."""
    bare = getattr(model.step, "bare", model)
    derivative, base = bare.derivative, plain_step(bare)

    def rates(s: Any, a: Any, p: Any, dt: Any) -> Any:
        h = 1e-3 * dt
        return derivative(s, a, p) if derivative else _mean_rate(s, base(s, a, p, h), h)

    return rates


def _mean_rate(s: Named, ahead: Mapping[str, Any], dt: Any) -> dict[str, Any]:
    return {n: (ahead[n] - s[n]) / dt for n in s}


def _added(
    effects: Sequence[Effect], s: Named, a: Any, own: Any, clock: Mapping[str, Any], p: Any, dt: Any
) -> dict[str, Any]:
    """Return the sum of the effects' rates at one moment, by state."""
    total: dict[str, Any] = {}
    for e in effects:
        t = clock.get(_clock(e), 0.0)
        added = _family(e).rate(s, a, own, t, quantities_of(e, p), e.site)
        for n, rate in braked(e, s, added, 0.5 * dt).items():
            total[n] = total[n] + rate if n in total else rate
    return total


def _through(
    limits: Sequence[Effect], base: Step, s: Named, a: Any, p: Any, dt: Any, now: Mapping[str, Any]
) -> tuple[Named, dict[str, Any]]:
    """Return the model's step under limits of its mean rate over parts of it, and its mean rate."""
    if not limits:
        ahead = base(s, a, p, dt)
        return Named("state", tuple(s), [ahead[n] for n in s]), _mean_rate(s, ahead, dt)
    parts = max([_family(e).parts for e in limits])
    final, h, touched, mean = s, dt / parts, 0.0, dict.fromkeys(s, 0.0)
    for part in range(parts):
        ahead = base(final, a, p, h)
        own = _mean_rate(final, ahead, h)
        added = _added(limits, final, a, own, {z: t + part * h for z, t in now.items()}, p, h)
        values = [ahead[n] + h * added[n] if n in added else ahead[n] for n in s]
        final = Named("state", tuple(s), values)
        mean = {n: mean[n] + own[n] / parts for n in s}
        touched = touched + sum(np.abs(rate) for rate in added.values())
    ahead = base(s, a, p, dt)
    free = _mean_rate(s, ahead, dt)
    after = Named("state", tuple(s), [np.where(touched > 0, final[n], ahead[n]) for n in s])
    return after, {n: np.where(touched > 0, mean[n], free[n]) for n in s}


def _kicked(s: Named, rate: Values, dt: Any) -> Named:
    """Return the state after half a step of an added rate alone."""
    moved = [s[n] + 0.5 * dt * rate[n] if n in rate else s[n] for n in s]
    return Named("state", tuple(s), moved)


def _medium_step(effect: Effect, whole: Values, dt: float) -> tuple[Step, dict[str, str]]:
    base, model = plain_step(effect.site.model), effect.site.model

    def step(s: Any, a: Any, p: Any, dt: Any) -> dict[str, Any]:
        c = quantities_of(effect, p)
        after = base(through_it(effect, own_state(model, s), c), a, p, dt)
        return over_ground(effect, Named("state", tuple(after), list(after.values())), c, dt)

    return step, {}
