"""Effects of a vehicle's motion over the ground: drift, slip, understeer, slope, patches.

Equations are in terms of the position (x, y), the heading psi and the speed v of the model's roles.
A drift over the ground is a wind or a conveyor, one with the heading a carpet or misaligned wheels;
a side slip is k times the lateral acceleration, times v; a lever arm is how far ahead (a) and to
the left (b) of the model's point the logged one lies; a patch is a doormat, a puddle.
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
    two_axes,
)
from grounded.model import Model
from grounded.result import per_second


def _two_drifts(site: Site) -> tuple[Quantity, ...]:
    return two_axes(per_second(site.unit(site.target)))


def _heading(site: Site) -> str:
    name = places.heading(site.model)
    assert name is not None
    return name


def _speed(site: Site) -> str:
    name = places.speed(site.model) or places.speed_input(site.model)
    assert name is not None
    return name


def _velocity(s: Any, a: Any, site: Site) -> Any:
    """Return the speed, which may be a state or an input."""
    name = _speed(site)
    return s[name] if name in site.model.state_names else a[name]


LARGEST = 0.35  # radius of a patch relative to the size of where the robot was: else it is no place


def _understeer(site: Site) -> tuple[Quantity, ...]:
    fastest = site.scales.peak(_speed(site))
    return (Quantity("k", "s^2/m^2", low=-0.5 / fastest**2, high=20 / fastest**2),)


def _patch(site: Site) -> tuple[Quantity, ...]:
    """Return the quantities of a patch, on a grid of 6 x 6 places (12 along one axis) visited."""
    where = places.position(site.model)
    count = 6 if len(where) == 2 else 12
    spreads = [site.scales.spread(name) for name in where]
    found = [Quantity("c", per_second(site.unit(site.target)))]
    for name, spread in zip(where, spreads, strict=True):
        low = site.scales.low.get(name, -1.0)
        grid = low + spread * (np.arange(count) + 0.5) / count
        known = name in site.scales.low
        ends = (low, low + spread) if known else (-np.inf, np.inf)  # of an adopted patch
        found.append(Quantity(f"{name}0", site.unit(name), grid, *ends, places=count))
    size = float(np.sqrt(np.prod(spreads))) if len(where) == 2 else spreads[0]
    radii = tuple(size * r for r in (0.08, 0.16))
    ends = (0.02 * size, LARGEST * size) if site.scales.low else (0.0, np.inf)
    found.append(Quantity("radius", site.unit(where[0]), radii, *ends, places=2))
    return tuple(found)


def _patch_targets(model: Model) -> list[str]:
    where, heading = places.position(model), places.heading(model)
    found = [n for n in places.dynamic(model) if n not in where]
    return [*found, *([heading] if heading else [])] if where else []


def _in_the_plane(s: Any, site: Site, ahead: Any, left: Any) -> Values:
    """Return a velocity ahead and to the left of the heading, by state of the position."""
    x, y = site.targets
    cos, sin = np.cos(s[_heading(site)]), np.sin(s[_heading(site)])
    return {x: ahead * cos - left * sin, y: ahead * sin + left * cos}


def _slip_rate(s: Any, a: Any, own: Any, t: Any, c: Any, site: Site) -> Values:
    v = s[_speed(site)]
    return _in_the_plane(s, site, 0.0, -c["k"] * v * v * own[_heading(site)])


def _understeer_rate(s: Any, a: Any, own: Any, t: Any, c: Any, site: Site) -> Values:
    v = _velocity(s, a, site)
    return {site.target: own[site.target] * (1 / (1 + c["k"] * v * v) - 1)}


def _grip(site: Site) -> tuple[Quantity, ...]:
    """Return the limit of lateral acceleration, scanned down from twice the largest estimate."""
    model, scales = site.model, site.scales
    turning = scales.spread(site.target) / max(scales.duration, scales.dt)
    rate = places.role(model, "heading_rate")
    turning = scales.peak(rate[0]) if rate else 4 * turning
    most = max(scales.peak(_speed(site)) * turning, 1e-3)
    grid = np.geomspace(2.0, 0.2, 10) * most
    return (Quantity("a", "m/s^2", grid, 0.0, np.inf, start=4 * most, places=6),)


def _grip_rate(s: Any, a: Any, own: Any, t: Any, c: Any, site: Site) -> Values:
    rate = own[site.target]
    most = c["a"] / np.maximum(np.abs(_velocity(s, a, site)), 1e-3)
    return {site.target: -beyond(rate, most)}


def _drag_rate(s: Any, a: Any, own: Any, t: Any, c: Any, site: Site) -> Values:
    driven, _ = coupled(site)
    return {driven: -c["k"] * np.abs(from_source(s, a, site)) * s[driven]}


def _corners(model: Model) -> list[str]:
    v = places.speed(model)
    return [f"{v}<-{name}" for name in places.steering(model)] if v else []


def _lever_rate(s: Any, a: Any, own: Any, t: Any, c: Any, site: Site) -> Values:
    turn = own[_heading(site)]
    return _in_the_plane(s, site, -turn * c["b"], turn * c["a"])


def _slope_rate(s: Any, a: Any, own: Any, t: Any, c: Any, site: Site) -> Values:
    psi = s[_heading(site)]
    return {site.target: c["a"] * np.cos(psi) + c["b"] * np.sin(psi)}


def _patch_rate(s: Any, a: Any, own: Any, t: Any, c: Any, site: Site) -> Values:
    far: Any = 0.0
    for name in places.position(site.model):
        away = (s[name] - c[f"{name}0"]) / c["radius"]
        far = far + away * away
    return {site.target: c["c"] * np.exp(-0.5 * far)}


def _moving(model: Model) -> bool:
    return bool(_turning(model) and places.speed(model) and places.plane(model))


def _turning(model: Model) -> list[str]:
    """Return the heading, if the speed is a state or an input."""
    name = places.heading(model)
    return [name] if name and (places.speed(model) or places.speed_input(model)) else []


drift_world = RateFamily(
    name="drift_world",
    equation="x' = model + a, y' = model + b",
    sentence="everything drifts by ({a}, {b}) over the ground",
    targets=places.plane,
    quantities=_two_drifts,
    lookalikes=("offset", "drift_body", "sensor_bias"),
    rate=lambda s, a, own, t, c, site: {
        n: c[q] + 0.0 * s[n] for n, q in zip(site.targets, "ab", strict=True)
    },
)

drift_body = RateFamily(
    name="drift_body",
    equation="x' = model + a cos(psi) - b sin(psi), y' = model + a sin(psi) + b cos(psi)",
    sentence="it drifts by {a} ahead and {b} to the left of its heading",
    targets=places.plane,
    quantities=_two_drifts,
    lookalikes=("drift_world", "side_slip", "sensor_bias", "odometry_scale"),
    rate=lambda s, a, own, t, c, site: _in_the_plane(s, site, c["a"], c["b"]),
)

side_slip = RateFamily(
    name="side_slip",
    equation="velocity to the left = -k v^2 psi'",
    sentence="it slides {k>outwards|inwards} in turns, by {k} of speed times lateral acceleration",
    targets=lambda model: places.plane(model) if _moving(model) else [],
    quantities=lambda site: (Quantity("k", "s^2/m"),),
    lookalikes=("drift_body", "understeer", "sensor_delay"),
    rate=_slip_rate,
    needs_own=True,
)

understeer = RateFamily(
    name="understeer",
    equation="psi' = model / (1 + k v^2)",
    sentence="it understeers by {k}, turning less the faster it drives",
    targets=_turning,
    quantities=_understeer,
    lookalikes=("rate_gain", "coupling", "parameter"),
    rate=_understeer_rate,
    needs_own=True,
)

grip_limit = RateFamily(
    name="grip_limit",
    equation="psi' = clip(model, -a / |v|, a / |v|)",
    sentence="its tyres let go at a lateral acceleration of {a}",
    targets=_turning,
    quantities=_grip,
    lookalikes=("understeer", "saturation", "slew_limit", "side_slip"),
    rate=_grip_rate,
    needs_own=True,
    parts=4,
)

cornering_drag = RateFamily(
    name="cornering_drag",
    equation="v' = model - k |delta| v   (v<-delta)",
    sentence="{driven} is braked by {k} times itself and the size of {source}",
    targets=_corners,
    quantities=lambda site: (Quantity("k", per_second("1") + "/" + site.unit(coupled(site)[1])),),
    lookalikes=("viscous_friction", "quadratic_drag", "coupling", "coulomb_friction"),
    rate=_drag_rate,
    brakes=True,
)

lever_arm = RateFamily(
    name="lever_arm",
    equation="x' = model - psi' (a sin psi + b cos psi), y' = model + psi' (a cos psi - b sin psi)",
    sentence="the tracked point lies [{a} further {a>ahead|back} & {b} further to the "
    "{b>left|right}] than the model's",
    targets=places.plane,
    quantities=lambda site: tuple(Quantity(q, site.unit(site.target)) for q in "ab"),
    lookalikes=("side_slip", "drift_body", "sensor_delay", "parameter"),
    rate=_lever_rate,
    needs_own=True,
)

slope = RateFamily(
    name="slope",
    equation="v' = model + a cos(psi) + b sin(psi)",
    sentence="the ground slopes, by {a} towards {axis_1} and {b} towards {axis_2}",
    targets=lambda model: [v] if _moving(model) and (v := places.speed(model)) else [],
    quantities=_two_drifts,
    lookalikes=("offset", "patch", "coulomb_friction"),
    rate=_slope_rate,
)

patch = RateFamily(
    name="patch",
    loose=True,
    equation="s' = model + c exp(-|q - q0|^2 / (2 radius^2))",
    sentence="the rate of {target} differs by {c} around {place}, within about {radius}",
    targets=_patch_targets,
    quantities=_patch,
    lookalikes=("slope", "periodic", "trend"),
    rate=_patch_rate,
)

FAMILIES = (
    *(drift_world, drift_body, side_slip, lever_arm, understeer, grip_limit, cornering_drag),
    *(slope, patch),
)
