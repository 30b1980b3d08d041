"""Added rates: constant, proportional, coupled, growing, periodic; and limits of rates.

    s' = model + rate                  the least specific families, which name no mechanism
    s' = clip(model, -r, r)            a servo that follows with a lag, but at a limited speed

`slew_limit` differs from `rate_limit`, which bounds the command before the lag: here the lag's own
rate is bounded, so large moves go at r until the target is near. It applies to states that follow
an input independently: their rate depends only on inputs and on themselves, and falls with them. It
acts on the mean rate of each quarter of a step, so the limit can end within a step, and the lag may
be much shorter than a step. A step that does not reach the limit is the model's own.

No rate is added to a position or an angle whose rate is another state by definition, since no force
can do that. Errors of its sensors are found by `grounded.accounts`; a gear is a `rate_gain`. But
two wheels of unequal size turn a vehicle in proportion to its speed, unseen by their encoders.

`correction` is never a candidate for a cause:

    s' = model + sum_k w_k g_k(r) / sum_k g_k(r)   (s<-r)

with Gaussian bells g_k at KNOTS points from lo to hi, constant beyond them. A diagnosis fits it to
what no effect explains (`grounded.diagnosis.hypotheses.leftover`). Once adopted, it is part of
the model like any effect.

Friction of a velocity is viscous, Coulomb, quadratic, static:

    v' = model + rate(v)

Viscous and quadratic drag act on any velocity. The sign of Coulomb friction is smoothed over a
small width w (a hundredth of the largest speed, or a fitted value up to three tenths): with noise
around zero a sharp sign would chatter, and real friction needs some distance to build up. None of
the three reverses a motion within a step, however strong it is, or reduces the damping below zero.
For the friction of a joint that an input drives, `joint` has a torque instead.
Stiction holds a velocity below v_s, where the model's own rate is cancelled up to c,

    v' = own - exp(-(v / v_s)^2) clip(own + 2 v, -c, c)               (the 2 is 2 per second)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded import places
from grounded.effects.family import (
    Quantity,
    RateFamily,
    Site,
    Values,
    beyond,
    coupled,
    from_source,
    speed_limit,
    width,
)
from grounded.result import per_second

PERIODS = 1.5  # fewest periods of a wave in the longest trial


def _coupling(site: Site) -> tuple[Quantity, ...]:
    target, source = coupled(site)
    return (Quantity("k", f"{per_second(site.unit(target))} per {site.unit(source)}"),)


def _periodic(site: Site) -> tuple[Quantity, ...]:
    """Return a wave's quantities, its frequency scanned in steps of half a bin.

    A slower wave than PERIODS a trial can't be told from a drift. An adopted one may be slower.
    """
    scales = site.scales
    lowest = PERIODS / scales.duration
    highest = max(min(0.2 / scales.dt, 5.0), lowest)
    bins = max((highest - lowest) * scales.duration, 1.0)
    count = int(min(max(2 * bins, 4), 40))
    grid = 2 * np.pi * np.linspace(lowest, highest, count)
    slowest = float(grid[0]) if scales.high else 0.0
    fastest = 2 * np.pi * max(0.45 / scales.dt, lowest)
    unit = per_second(site.unit(site.target))
    omega = Quantity("omega", "rad/s", grid, slowest, fastest, places=bins)
    return (Quantity("A", unit), Quantity("B", unit), omega)


def _coupling_rate(s: Any, a: Any, own: Any, t: Any, c: Any, site: Site) -> Values:
    return {coupled(site)[0]: c["k"] * from_source(s, a, site)}


def _periodic_rate(s: Any, a: Any, own: Any, t: Any, c: Any, site: Site) -> Values:
    phase = c["omega"] * t
    wave = c["A"] * np.sin(phase) + c["B"] * np.cos(phase)
    return {site.target: wave + 0.0 * s[site.target]}


offset = RateFamily(
    name="offset",
    loose=True,
    equation="s' = model + c",
    sentence="{target} drifts by {c}",
    targets=places.states,
    quantities=lambda site: (Quantity("c", per_second(site.unit(site.target))),),
    lookalikes=("input_bias", "trend", "drift_world", "sensor_bias", "parameter"),
    rate=lambda s, a, own, t, c, site: {site.target: c["c"] + 0.0 * s[site.target]},
)

rate_gain = RateFamily(
    name="rate_gain",
    equation="s' = (1 + g) model",
    sentence="{target} changes {g%faster|slower} than modelled",
    turned="{target} changes the other way round",
    targets=places.but_position,
    quantities=lambda site: (Quantity("g", "1", low=-3.0, high=5.0, absurd=4.0),),
    lookalikes=("input_gain", "understeer", "parameter", "sensor_scale"),
    rate=lambda s, a, own, t, c, site: {site.target: c["g"] * own[site.target]},
    needs_own=True,
)

trend = RateFamily(
    name="trend",
    loose=True,
    equation="s' = model + k t",
    sentence="{target} drifts more and more, by {k}",
    targets=places.dynamic,
    quantities=lambda site: (Quantity("k", per_second(per_second(site.unit(site.target)))),),
    lookalikes=("input_fade", "offset", "periodic"),
    vague=0.5,
    rate=lambda s, a, own, t, c, site: {site.target: c["k"] * t + 0.0 * s[site.target]},
    timed=True,
)

coupling = RateFamily(
    name="coupling",
    loose=True,
    equation="s' = model + k r   (s<-r)",
    sentence="{source} acts on {driven} by {k}",
    targets=places.pairs,
    quantities=_coupling,
    lookalikes=("viscous_friction", "rate_gain", "understeer", "parameter"),
    vague=1.0,
    rate=_coupling_rate,
)

crosstalk = RateFamily(
    name="crosstalk",
    loose=True,
    equation="s' = model + k u   (s<-u)",
    sentence="{source} also act{s} on {driven}, by {k}",
    targets=places.crossed,
    quantities=_coupling,
    lookalikes=("coupling", "input_gain", "periodic", "cornering_drag"),
    vague=0.7,
    rate=_coupling_rate,
)

periodic = RateFamily(
    name="periodic",
    loose=True,
    equation="s' = model + A sin(omega t) + B cos(omega t)",
    sentence="{target} is shaken at {omega}",
    targets=places.dynamic,
    quantities=_periodic,
    lookalikes=("trend", "patch"),
    vague=1.0,
    rate=_periodic_rate,
    timed=True,
)

slew_limit = RateFamily(
    name="slew_limit",
    equation="s' = clip(model, -r, r)",
    sentence="{target} can't change faster than {r}",
    targets=places.following,
    quantities=lambda site: speed_limit(site, per_second(site.unit(site.target))),
    lookalikes=("rate_limit", "first_order_lag", "saturation"),
    rate=lambda s, a, own, t, c, site: {site.target: -beyond(own[site.target], c["r"])},
    needs_own=True,
    parts=4,
)

# Friction of a velocity.

HALTS = 2.0  # most that friction may take off in a control step, in units of the largest speed


def _least(site: Site, power: int) -> float:
    """Return the lower bound of a friction coefficient, minus the damping of the model.

    In units of speed^(1 - power) per second; power 1 is viscous friction.
    """
    model, name = site.model, site.target
    if not site.scales.moves(name):
        return -np.inf
    i, (f_x, _, dt) = model.state_names.index(name), places.slopes(model, places.INSTANT_S)
    damping = float(np.median(1 - f_x[:, i, i])) / dt
    return -max(damping, 0.0) * site.scales.peak(name) ** (1 - power)


def _opposing(site: Site, name: str, unit: str, power: int) -> Quantity:
    """Return the coefficient of a friction that grows with this power of the speed.

    A value that would stop any motion within a step is not claimed: it is the sign of a dead or
    exchanged sensor of the speed.
    """
    peak = max(site.scales.peak(site.target), 1e-12)
    most = HALTS / site.scales.dt * peak ** (1 - power)
    return Quantity(name, unit, low=_least(site, power), high=10 * most, absurd=most)


def _quadratic(site: Site) -> tuple[Quantity, ...]:
    unit = site.unit(site.target)
    squared = {"m/s": "1/m", "rad/s": "1/rad"}.get(unit, f"1/({unit} s)")
    return (_opposing(site, "k", squared, 2),)


def _stiction(site: Site) -> tuple[Quantity, ...]:
    unit, peak = site.unit(site.target), site.scales.peak(site.target)
    grid = np.geomspace(0.05, 4.0, 8) * peak
    return (
        Quantity("c", per_second(unit), grid, 0.0, np.inf, places=6),
        Quantity("v_s", unit, fixed=True, start=0.05 * peak),
    )


def _stiction_rate(s: Any, a: Any, own: Any, t: Any, c: Any, site: Site) -> Values:
    v = s[site.target]
    slow = v / c["v_s"]
    drive = own[site.target] + 2.0 * v
    return {site.target: -np.exp(-slow * slow) * (drive - beyond(drive, c["c"]))}


viscous_friction = RateFamily(
    name="viscous_friction",
    equation="v' = model - k v",
    sentence="{target} is damped {k>by|less than modelled, by} {k}",
    targets=places.velocities,
    quantities=lambda site: (_opposing(site, "k", "1/s", 1),),
    lookalikes=("quadratic_drag", "coulomb_friction", "input_gain", "parameter"),
    rate=lambda s, a, own, t, c, site: {site.target: -c["k"] * s[site.target]},
    brakes=True,
)

coulomb_friction = RateFamily(
    name="coulomb_friction",
    equation="v' = model - c sign(v)",
    sentence="{target} is opposed by {c>a dry friction of|less dry friction than modelled, by} {c}",
    targets=places.velocities,
    quantities=lambda site: (
        _opposing(site, "c", per_second(site.unit(site.target)), 0),
        width(site, site.target),
    ),
    lookalikes=("dead_zone", "viscous_friction", "offset", "stiction"),
    rate=lambda s, a, own, t, c, site: {
        site.target: -c["c"] * np.tanh(s[site.target] / c["width"])
    },
    brakes=True,
    dry=True,
)

quadratic_drag = RateFamily(
    name="quadratic_drag",
    equation="v' = model - k v |v|",
    sentence="{target} is opposed by {k>a drag of|less drag than modelled, by} {k} times "
    "its square",
    targets=places.velocities,
    quantities=_quadratic,
    lookalikes=("viscous_friction", "coulomb_friction", "saturation"),
    rate=lambda s, a, own, t, c, site: {
        site.target: -c["k"] * s[site.target] * np.abs(s[site.target])
    },
    brakes=True,
)

stiction = RateFamily(
    name="stiction",
    equation="v' = own - exp(-(v/v_s)^2) clip(own + 2 v, -c, c)",
    sentence="{target} sticks until it is driven harder than {c}",
    targets=places.velocities,
    quantities=_stiction,
    lookalikes=("stall", "dead_zone", "coulomb_friction"),
    rate=_stiction_rate,
    needs_own=True,
    dry=True,
)


# A smooth curve added to a state's rate, never a candidate for a cause.

KNOTS = 7
WIDTH = 0.7  # standard deviation of a bell, in distances between knots


def bells(r: Any, lo: Any, hi: Any) -> list[Any]:
    """Return the KNOTS normalised basis functions at r, which sum to 1."""
    apart = (hi - lo) / (KNOTS - 1)
    inside = np.minimum(np.maximum(r, lo), hi)
    found = [
        np.exp(-0.5 * ((inside - lo - k * apart) / (WIDTH * apart)) ** 2) for k in range(KNOTS)
    ]
    total = sum(found)
    return [one / total for one in found]


def _weights(site: Site) -> tuple[Quantity, ...]:
    target, source = coupled(site)
    ends = [Quantity(n, site.unit(source), fixed=True) for n in ("lo", "hi")]
    unit = per_second(site.unit(target))
    return (*ends, *[Quantity(f"w{k}", unit, fixed=True) for k in range(KNOTS)])


def _curve_rate(s: Any, a: Any, own: Any, t: Any, c: Any, site: Site) -> Values:
    values = bells(from_source(s, a, site), c["lo"], c["hi"])
    return {coupled(site)[0]: sum(c[f"w{k}"] * g for k, g in enumerate(values))}


correction = RateFamily(
    name="correction",
    equation="s' = model + curve(r)   (s<-r)",
    sentence="{driven} lacks a rate that depends on {source}: a correction, not a cause",
    targets=lambda model: [
        f"{s}<-{r}" for s in model.state_names for r in (*model.state_names, *model.input_names)
    ],
    quantities=_weights,
    rate=_curve_rate,
)

FAMILIES = (offset, rate_gain, trend, coupling, crosstalk, periodic, slew_limit)
FRICTION = (viscous_friction, coulomb_friction, quadratic_drag, stiction)
ADDED = (
    offset,
    trend,
    coupling,
    crosstalk,
    periodic,
)  # not for a state whose rate is another state, except a heading that the speed turns
