"""Effects of a surrounding medium that moves, pushes or is carried along: a current, a wind.

With the heading psi and the body velocities u ahead and v to the side in the plane
(x' = u cos psi - v sin psi, y' = u sin psi + v cos psi; `places.body_velocity`), all over ground:

    current      the medium moves by (a, b) over ground, and the model's equations for u and v
                 apply to the velocity through it. With V_c adding (a, b) in the vehicle's axes,

                     s+ = V_c(f(V_-c(s))),     x+ = ... + dt a,    y+ = ... + dt b

    push_world   u' += a cos psi + b sin psi,   v' += -a sin psi + b cos psi

    coriolis     u' += k v r,   v' += k u r   or   r' += k u v,   r the rate of the heading

The first is a Galilean transformation. It is exact for any model of forces that depend on
velocities, with linear or quadratic drag, different ahead and sideways: one (a, b) in m/s, where a
push would need a different size for each. Terms of the rotating axes (v r, -u r) are unchanged. A
model without drag does not feel a current; what pushes it nevertheless (wind on a hull, a tilted
floor) is the second. The third is the water or air that a hull sets in motion: it adds unequal
masses ahead and sideways, so the products of velocities differ from a rigid body's (v r and -u r
times the ratio of the masses, and a moment by their difference, named after Munk). Each of the
three rates has its own effect, since simple models leave out one or the other.

T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, 2011, section 8.3:
equations of motion with ocean currents, in terms of the relative velocity; section 6.3: added mass
and the Coriolis and centripetal matrix.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from grounded import places
from grounded.compile.names import Named
from grounded.effects.family import (
    Effect,
    MediumFamily,
    Quantity,
    RateFamily,
    Scales,
    Site,
    Values,
    parallel,
    two_axes,
)
from grounded.effects.plain_step import adopted
from grounded.frozen import Array
from grounded.model import Model
from grounded.result import per_second

FELT = 1e-4  # [1/s^2] smallest change of a velocity's rate by a medium that moves by 0.2


def medium_of(model: Model) -> Effect | None:
    """Return the moving medium that was added to a model, or None."""
    return next((e for e in adopted(model) if isinstance(e.family, MediumFamily)), None)


def through_it(effect: Effect, s: Any, c: Any) -> Named:
    """Convert states s over ground to states through the medium."""
    return _moved(s, effect.family.shift(s, c, effect.site), -1.0)  # type: ignore[attr-defined]


def over_ground(effect: Effect, s: Any, c: Any, dt: Any) -> dict[str, Any]:
    """Convert states through the medium to states over ground, after a step of dt."""
    family, site = effect.family, effect.site
    assert isinstance(family, MediumFamily)
    after = _moved(_moved(s, family.shift(s, c, site), 1.0), family.drift(c, site), dt)
    return dict(after)


def _moved(s: Any, by: Values, times: Any) -> Named:
    return Named("state", tuple(s), [s[n] + times * by[n] if n in by else s[n] for n in s])


def _in_its_axes(s: Any, c: Any, site: Site) -> Values:
    """Return the vector (a, b), given in the axes of the ground, in the axes of the vehicle."""
    heading = places.heading(site.model)
    assert heading is not None
    cos, sin = np.cos(s[heading]), np.sin(s[heading])
    ahead, aside = site.targets
    return {ahead: c["a"] * cos + c["b"] * sin, aside: c["b"] * cos - c["a"] * sin}


def _over_ground(c: Any, site: Site) -> Values:
    return dict(zip(places.position(site.model), (c["a"], c["b"]), strict=True))


def _pushed(model: Model) -> list[str]:
    found = places.body_velocity(model)
    return ["+".join(found)] if found else []


def _carried(model: Model) -> list[str]:
    """Return the velocities of a model that a moving medium affects."""
    felt, _ = _felt(model)
    return _pushed(model) if np.abs(felt).max(initial=0.0) > FELT else []


def renamed(model: Model) -> dict[str, str]:
    """Return {dropped: kept}: with linear, isotropic drag a push is equivalent to a current."""
    felt, axes = _felt(model)
    names = _carried(model) if parallel(felt, axes) else []
    return {f"push_world:{n}": f"current:{n}" for n in names}


def _felt(model: Model) -> tuple[Array, Array]:
    """Return what a moving medium adds to the rates of (u, v), and its velocity there, (S, 2)."""
    if not (found := places.body_velocity(model)):
        return np.zeros((0, 2)), np.zeros((0, 2))
    effect = current.at(Site(model, found, Scales()))
    (x, u), dt = places.samples(model, 8), places.probe(model, places.INSTANT_S)
    names, c = model.state_names, {"a": 0.1, "b": 0.2}
    plain = model.system.step(x, u, model.values, dt)
    start = Named("state", names, list(x.T))
    seen = np.stack(list(through_it(effect, start, c).values()), axis=-1)
    after = model.system.step(seen, u, model.values, dt)
    moved = over_ground(effect, Named("state", names, list(after.T)), c, dt)
    axes = _in_its_axes(start, c, effect.site)
    felt = [(moved[n] - plain[:, names.index(n)]) / dt for n in found]
    return np.stack(felt, axis=-1), np.stack([axes[n] for n in found], axis=-1)


@lru_cache(maxsize=8)  # asked at every step of a rate
def turning(model: Model) -> tuple[str, ...]:
    """Return the body velocities (u, v) and the rate r of the heading; () if one is no state."""
    found, turned = places.body_velocity(model), places.heading(model)
    if not found or turned is None:
        return ()
    own = places.motion(model)
    rates = places.role(model, "heading_rate") or places.integrated(own).get(turned, ())[:1]
    return (*found, *rates) if rates and rates[0] in own.state_names else ()


def factors(site: Site) -> tuple[str, str]:
    """Return the two velocities whose product acts on the third, the target."""
    one, other = (n for n in turning(site.model) if n != site.target)
    return one, other


def _product(site: Site) -> tuple[Quantity, ...]:
    one, other = factors(site)
    units = site.unit(site.target), site.unit(one), site.unit(other)
    known = {("m/s", "m/s", "rad/s"): "1", ("rad/s", "m/s", "m/s"): "rad/m^2"}
    unit = f"{per_second(units[0])} per {units[1]} {units[2]}"
    return (Quantity("k", known.get(units, unit)),)


def _product_rate(s: Any, a: Any, own: Any, t: Any, c: Any, site: Site) -> Values:
    one, other = factors(site)
    return {site.target: c["k"] * s[one] * s[other]}


current = MediumFamily(
    name="current",
    equation="model of (u, v) through a medium that moves by (a, b) over ground",
    sentence="the water or air moves, by {a} along {axis_1} and {b} along {axis_2}",
    targets=_carried,
    quantities=lambda site: two_axes(site.unit(site.target)),
    lookalikes=("push_world", "offset", "slope", "drift_world", "drift_body"),
    shift=_in_its_axes,
    drift=_over_ground,
)

push_world = RateFamily(
    name="push_world",
    equation="u' = model + a cos(psi) + b sin(psi), v' = model - a sin(psi) + b cos(psi)",
    sentence="something pushes it, by {a} along {axis_1} and {b} along {axis_2}",
    targets=_pushed,
    quantities=lambda site: two_axes(per_second(site.unit(site.target))),
    lookalikes=("current", "offset", "slope", "patch"),
    rate=lambda s, a, own, t, c, site: _in_its_axes(s, c, site),
)

coriolis = RateFamily(
    name="coriolis",
    equation="u' = model + k v r, v' = model + k u r or r' = model + k u v",
    sentence="the rate of {driven} should have {k} * {product} {k>more|less} (Coriolis forces, "
    "added mass)",
    targets=turning,
    quantities=_product,
    lookalikes=("rate_gain", "quadratic_drag", "coupling", "parameter"),
    vague=0.7,
    rate=_product_rate,
)

FAMILIES = (current, push_world, coriolis)
