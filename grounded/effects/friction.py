"""Friction of a velocity: viscous, Coulomb, quadratic, static.

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
from grounded.effects.family import Quantity, RateFamily, Site, Values, beyond, width
from grounded.result import per_second

HALTS = 2.0  # most that friction may take off in a control step, in units of the largest speed


def _least(site: Site, power: int) -> float:
    """Return the lower bound of a friction coefficient, minus the damping of the model.

    In units of speed^(1 - power) per second; power 1 is viscous friction. A negative coefficient
    means less friction than modelled.
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


def _viscous(site: Site) -> tuple[Quantity, ...]:
    return (_opposing(site, "k", "1/s", 1),)


def _coulomb(site: Site) -> tuple[Quantity, ...]:
    dry = _opposing(site, "c", per_second(site.unit(site.target)), 0)
    return (dry, width(site, site.target))


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
    quantities=_viscous,
    lookalikes=("quadratic_drag", "coulomb_friction", "input_gain", "parameter"),
    rate=lambda s, a, own, t, c, site: {site.target: -c["k"] * s[site.target]},
    brakes=True,
)

coulomb_friction = RateFamily(
    name="coulomb_friction",
    equation="v' = model - c sign(v)",
    sentence="{target} is opposed by {c>a dry friction of|less dry friction than modelled, by} {c}",
    targets=places.velocities,
    quantities=_coulomb,
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

FAMILIES = (viscous_friction, coulomb_friction, quadratic_drag, stiction)
