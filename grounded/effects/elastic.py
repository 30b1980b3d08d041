"""Losses with a memory of the motion: a friction that bends before it slides, a spring in a joint.

    u_eff = u - c y,      y' = (w - |w| y) / x                                   Dahl's friction
    u_eff = u - J z'',    J (z'' + 2 zeta v z' + v^2 z) = a u - J w'            a spring

Dahl (A solid friction model, 1968): bristles bend by y x before they slide, at full bend y = 1. So
a reversed friction builds up over the distance x. Its y depends on the path alone, not on the
speed: over a way v it moves to 1 - (1 - y) exp(-v / x), and the step is solved for this law.

A spring (Spong, Modeling and control of elastic joint robots, 1987) parts the inertia that an
input drives in two, which twist against each other by z. What the log shows moves with the speed w,
and J is the other one: the motor's, which the input drives (a = 1), or that of a load behind the
measured motor (a = 0). Without the spring both move as one, and z'' is what the log's side feels of
it. The step is exact where w' and u are constant within it.

The memory starts at rest. It follows from the motion and the inputs, so nothing disturbs it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from grounded.effects.drive import push
from grounded.effects.family import LossFamily, Quantity, Site, Values, coupled
from grounded.effects.joint import pairs_of, per_acceleration, strongest

PER_PERIOD = 8  # samples in a period of the fastest resonance that is looked for
PERIODS = 4  # periods of the slowest one in the longest trial
NEXT = 1.1  # ratio of resonances that are tried
SHARES = (0.1, 0.4)  # parts of the inertia that an input drives that are tried as its motor's
LARGEST_SHARE, SMALLEST_REST = (
    0.95,
    0.02,
)  # largest such part, and least that is left to the side that is shown
DAMPED = 0.05  # first damping ratio of a spring
NEWTON = 3  # steps of the solution, from one that is at most a tenth off
FLAT = 1e-6  # way in units of the bristles' below which they bend in proportion


def _bending(site: Site) -> tuple[Quantity, ...]:
    tau, w = coupled(site)
    first, stroke = site.scales.turns.get(w, (0.01 * site.scales.peak(w), site.scales.peak(w)))
    ways = np.geomspace(first, max(0.5 * stroke, 2 * first), 6)
    c = Quantity("c", site.unit(tau), low=0.0, high=strongest(site))
    unit = site.unit(w).removesuffix("/s")
    return (c, Quantity("x", unit, ways, 0.3 * first, stroke, places=4))


def _bends(site: Site) -> bool:
    """Check that the motion reverses, and that enough samples lie within half of a stroke."""
    first, stroke = site.scales.turns.get(coupled(site)[1], (1.0, 0.0))
    return first < 0.5 * stroke


def _bent(y: Any, way: Any, x: Any) -> tuple[Any, Any]:
    """Return y after a way, and its mean along it."""
    part, to = np.abs(way) / x, np.where(way < 0, -1.0, 1.0)
    left = np.exp(-part)
    mean = np.where(part > FLAT, (1 - left) / np.maximum(part, FLAT), 1 - 0.5 * part)
    return to + (y - to) * left, to + (y - to) * mean


def _dragged(w: Any, free: Any, gain: Any, u: Any, c: Any, dt: Any) -> Any:
    """Return the mean of c y over a step, from the way X x of the step.

        X - K (1 - s y) (1 - exp(-X)) / X = R,    K = gain dt c / (2 x),  s: sign of the way

    solves it, and the left side rises with X > 0. Newton's method starts at the root for the mean
    1 / (1 + X / 2).
    """
    y, K = c["y"], 0.5 * gain * dt * c["c"] / c["x"]
    whole = 0.5 * dt * (w + free) / c["x"]
    s = np.where(whole < K * y, -1.0, 1.0)
    R, more = s * whole - K, K * (1 - s * y)
    half = 0.5 * R - 1
    X = half + np.sqrt(half * half + 2 * np.maximum(more + R, 0.0))
    for _ in range(NEWTON):
        X = np.maximum(X, FLAT)
        left = np.exp(-X)
        mean = (1 - left) / X
        X = X - (X - more * mean - R) / (1 + more * (mean - left) / X)
    return c["c"] * _bent(y, s * np.maximum(X, 0.0) * c["x"], c["x"])[1]


def _bend_later(w: Any, end: Any, gain: Any, u: Any, c: Any, dt: Any) -> Values:
    return {"y": _bent(c["y"], 0.5 * dt * (w + end), c["x"])[0]}


def _spring(site: Site, driven: float) -> tuple[Quantity, ...]:
    """Return the quantities of a spring; of a driven motor behind it also the whole inertia M."""
    whole, scales = 1 / max(push(site.model, site.joined), 1e-12), site.scales
    fastest = 1 / (PER_PERIOD * scales.dt)
    slowest = min(PERIODS / scales.duration, 0.5 * fastest)
    count = 1 + int(np.ceil(np.log(fastest / slowest) / np.log(NEXT)))
    fs = np.geomspace(slowest, fastest, count)
    f = Quantity("f", "Hz", fs, 0.1 * slowest, 2 * fastest, places=count)
    unit, shares = per_acceleration(site), tuple(part * whole for part in SHARES if driven)
    J = Quantity("J", unit, shares, 1e-3 * whole if driven else 0.0, LARGEST_SHARE * whole)
    found = (J, f, Quantity("zeta", "1", (DAMPED,), 0.0, 0.95))
    return (*found, Quantity("M", unit, fixed=True, start=whole)) if driven else found


def _own(c: Mapping[str, Any], driven: float) -> Any:
    """Return v [rad/s], how fast the hidden side swings on its spring while the other is held."""
    return 2 * np.pi * c["f"] * (np.sqrt(1 - c["J"] / c["M"]) if driven else 1.0)


class _Swing(NamedTuple):
    """Both sides of a spring over a time, under constant u and rate e of w without the loss.

    With n = 1 - J gain, the part of the inertia on the side that is shown,

        z'' + 2 zeta v / n z' + v^2 / n z = (a u / J - e) / n

    rest = (a u / J - e) / v^2
    z(t) = rest + D (z - rest) + S z',      z'(t) = E z' - v^2 / n S (z - rest)
    """

    v: Any
    n: Any
    S: Any
    E: Any
    D: Any


def _swing(c: Mapping[str, Any], gain: Any, dt: Any, driven: float) -> _Swing:
    v, n = _own(c, driven), np.maximum(1 - c["J"] * gain / dt, SMALLEST_REST)
    square, down = v * v / n, c["zeta"] * v / n
    turn = np.sqrt(np.maximum(square - down * down, SMALLEST_REST * square))
    e = np.exp(-down * dt)
    S, C = e * np.sin(turn * dt) / turn, e * np.cos(turn * dt)
    return _Swing(v, n, S, C - down * S, C + down * S)


def _sprung(w: Any, free: Any, gain: Any, u: Any, c: Any, dt: Any, driven: float) -> Any:
    """Return the mean of J z'' over a step."""
    v, n, S, E, _ = _swing(c, gain, dt, driven)
    pushed = driven * u - c["J"] * (v * v * c["z"] + (free - w) / dt)
    return (S * pushed / n + c["J"] * (E - 1) * c["r"]) / dt


def _spring_later(w: Any, end: Any, gain: Any, u: Any, c: Any, dt: Any, driven: float) -> Values:
    v, n, S, E, D = _swing(c, gain, dt, driven)
    # the rate without the loss: (end - w) / dt = e - gain / dt loss(e)
    still = (S * (driven * u - c["J"] * v * v * c["z"]) / n + c["J"] * (E - 1) * c["r"]) / dt
    e = ((end - w) + gain * still) / (dt + gain * c["J"] * S / (n * dt))
    rest = ((driven * u / c["J"] if driven else 0.0) - e) / (v * v)
    away = c["z"] - rest
    return {"z": rest + D * away + S * c["r"], "r": E * c["r"] - v * v / n * S * away}


def _spring_torque(w: Any, rate: Any, gain: Any, u: Any, c: Any, driven: float) -> Any:
    own = _own(c, driven)
    swing = 2 * c["zeta"] * own * c["r"] + own * own * c["z"] + rate
    return (driven * u - c["J"] * swing) / np.maximum(1 - c["J"] * gain, SMALLEST_REST)


def _at_rest(u: Any, c: Any, driven: float) -> Values:
    return {"z": driven * u / (c["J"] * _own(c, driven) ** 2) if driven else 0.0 * u, "r": 0.0 * u}


def _twist(site: Site) -> Mapping[str, str]:
    speed = site.unit(coupled(site)[1])
    return {"z": speed.removesuffix("/s"), "r": speed}


def _elastic(driven: float, name: str, equation: str, sentence: str) -> LossFamily:
    loss = partial(_sprung, driven=driven)
    return LossFamily(
        name=name,
        equation=equation,
        sentence=sentence,
        targets=pairs_of,
        quantities=partial(_spring, driven=driven),
        lookalikes=("added_inertia", "joint_spring", "first_order_lag", "delay", "sensor_lag"),
        loss=loss,
        early=loss,
        torque=partial(_spring_torque, driven=driven),
        memory=_twist,
        later=partial(_spring_later, driven=driven),
        rest=partial(_at_rest, driven=driven),
    )


dahl_friction = LossFamily(
    name="dahl_friction",
    equation="u_eff = u - c y, y' = (w - |w| y) / x   (u<-w)",
    sentence="{driven} loses up to {c} to a dry friction that builds up over a way of {x}",
    targets=pairs_of,
    quantities=_bending,
    lookalikes=("joint_friction", "coulomb_friction", "stiction", "backlash", "joint_spring"),
    loss=_dragged,
    early=_dragged,
    torque=lambda w, rate, gain, u, c: c["c"] * c["y"],
    memory=lambda site: {"y": "1"},
    later=_bend_later,
    rest=lambda u, c: {"y": 0.0 * u},
    shows=_bends,
)

elastic_joint = _elastic(
    1.0,
    "elastic_joint",
    "u_eff = u - J z'', J (z'' + 2 zeta v z' + v^2 z) = u - J w', v = 2 pi f sqrt(1 - J/M) "
    "  (u<-w)",
    "{driven} drives {source} through a spring, on which a motor of {J} and the rest of {M} swing "
    "at {f} with a damping ratio of {zeta}",
)

elastic_load = _elastic(
    0.0,
    "elastic_load",
    "u_eff = u - J z'', z'' + 2 zeta v z' + v^2 z = -w', v = 2 pi f   (u<-w)",
    "an inertia of {J} hangs on a spring behind {source}, and swings at {f} with a damping ratio "
    "of {zeta}",
)

FAMILIES = (dahl_friction, elastic_joint, elastic_load)
"""Families of joints with memory."""
