"""What a motion takes off the input that drives it: friction and inertia of a joint.

    u_eff = u - T(w),      target `tau<-w`: the input tau, and the velocity w that it drives

A joint's friction is a torque: through the inertia matrix, M(q)^-1 T, it acts on all accelerations,
not on its own alone. So it is put in where the model's own torque enters, and needs nothing of the
model but its step, be it NumPy, MuJoCo or any black box. How it is solved within a step: `losses`.

Where tau drives w alone through a constant inertia, the same friction is a Coulomb and a viscous
one of w itself, an inertia a gain of its rate, and they go by those names (`renamed`).

Pairs are found from the model: those where tau always pushes w the same way (a torque and its own
joint's velocity; the inertia matrix is positive there, elsewhere it changes sign or brakes).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import partial
from typing import Any

import numpy as np

from grounded.effects import places
from grounded.effects.family import Effect, LossFamily, Quantity, Site, coupled, width
from grounded.effects.losses import PARTS, dry
from grounded.frozen import Array
from grounded.model import Model

ALIKE = 0.999  # cosine from which two slopes are one
ONLY = 2e-3  # of a speed's answer: what an input may do besides
TURNS = 4  # times as many samples where axes stand anywhere
SOME = 0.1  # of a parameter's uncertainty, to see what it does
FORCES = ("N", "V", "A")  # what a unit of an effort begins with: N m, V ...


def _friction(site: Site) -> tuple[Quantity, ...]:
    tau, w = coupled(site)
    unit, most = site.unit(tau), _strongest(site)
    by = f"{unit} s/{site.unit(w).removesuffix('/s')}".removeprefix("1 ")
    viscous = Quantity("b", by, low=0.0, fixed=has_viscous(site.model, tau, w))
    return (Quantity("c", unit, low=0.0, high=most), viscous, width(site, w))


def _per_acceleration(site: Site) -> str:
    """N m by rad/s is kg m^2, N by m/s kg; others as a fraction."""
    tau, w = (site.unit(name) for name in coupled(site))
    other = f"{tau} s^2/{w.removesuffix('/s')}".removeprefix("1 ")
    return {"N m": "kg m^2", "N": "kg"}.get(tau, other)


def has_viscous(model: Model, tau: str, w: str) -> bool:
    """Whether uncertain parameters are the viscous part already: k w d f / d tau = d f / d p.

    One of them, or what uncertain ones do together: a motor's gain K and time constant T in
    w' = (K u - w) / T make any viscous friction, and data could not tell it from them. A constant
    (a back-EMF from the data sheet) is none: it stays as it is, and what it lacks is found.
    """
    uncertain = [i for i, p in enumerate(model.params.values()) if p.spread > 0]
    dt, (x, u) = places.probe(model, 1e-4), places.samples(model, 8 * (1 + len(uncertain)))
    _, f_u, f_p = model.system.sensitivities(x, u, model.values, dt)
    speed = x[:, model.state_names.index(w)]
    ours = (f_u[:, :, model.input_names.index(tau)] * speed[:, None]).reshape(-1)
    theirs = f_p.reshape(len(ours), -1)
    known = [i for i in uncertain if theirs[:, i].any()]
    if not known:
        return False
    sets = [[i] for i in known] + [known]
    axes = [np.linalg.qr(theirs[:, some])[0] for some in sets]
    alike = max(float(np.sum((each.T @ ours) ** 2)) for each in axes)
    return bool(alike > ALIKE**2 * float(np.sum(ours**2)) > 0)


def _strongest(site: Site) -> float:
    """A dry friction beyond which nothing would ever move: twice the largest input seen.

    An input that hardly does anything (a joint without a motor) bounds nothing.
    """
    tau, _ = coupled(site)
    return 2 * site.scales.peak(tau) if site.scales.moves(tau) else np.inf


def pairs_of(model: Model) -> list[str]:
    """`tau<-w` for every effort and the velocity that it always pushes the same way.

    Efforts are inputs in N, N m, V or A, of a simulator also those without a unit, and whatever
    moves several velocities through an inertia.
    """
    own, units = getattr(model.step, "timestep", 0.0), model.inputs.items()
    efforts = [n for n, unit in units if unit.startswith(FORCES) or (own and unit == "1")]
    if own and not efforts:
        efforts = list(model.input_names)
    velocities = places.velocities(model)
    dt, (x, u) = places.probe(model, 1e-2), places.samples(model, 8)
    found = {}
    if efforts and velocities:
        _, f_u = model.system.linearise(x, u, model.values, dt)
        found = {tau: _pushed(model, f_u, tau, velocities) for tau in efforts}
    if not own and len(found) < model.m:
        found |= _coupled(model, [n for n in model.input_names if n not in found])
    return [f"{tau}<-{found[tau]}" for tau in model.input_names if found.get(tau)]


def _pushed(model: Model, f_u: Array, tau: str, velocities: Sequence[str]) -> str | None:
    """The velocity that an input always pushes the same way, most of all."""
    by = {w: f_u[:, model.state_names.index(w), model.input_names.index(tau)] for w in velocities}
    least = {w: float(g.min()) for w, g in by.items() if g.min() > 1e-9}
    return max(least, key=lambda w: least[w], default=None)


def _coupled(model: Model, inputs: Sequence[str]) -> dict[str, str | None]:
    """The same for inputs of any unit that move a second velocity too, wherever the axes stand.

    Velocities are those of a position (q' = w). A diagonal of an inertia matrix is positive for all
    q: what pushes one way here and the other there (a thrust that is tilted) is no joint's motor.
    """
    axes = places.integrated(model)
    velocities = list(dict.fromkeys(w for w, _ in axes.values()))
    if len(velocities) < 2:
        return {}
    x, u = places.samples(model, 8 * TURNS)
    for i, name in enumerate(model.state_names):
        if name in axes:
            x[:, i] = np.linspace(-np.pi, np.pi, len(x)) * (1 + i)
    _, f_u = model.system.linearise(x, u, model.values, 1e-2)
    found = {tau: _pushed(model, f_u, tau, velocities) for tau in inputs}
    size = np.abs(f_u).max(axis=0)
    for tau, w in found.items():
        j = model.input_names.index(tau)
        by = {v: size[model.state_names.index(v), j] for v in velocities}
        if w is not None and not any(by[v] > ONLY * by[w] for v in velocities if v != w):
            found[tau] = None  # coulomb_friction:w says the same
    return found


def _inertia(w: Any, free: Any, gain: Any, u: Any, c: Any, dt: Any) -> Any:
    wanted = c["J"] / dt
    return wanted * (free - w) / np.maximum(1 + gain * wanted, 0.1)


def _carried(moved: Any, gain: Any, u: Any) -> Any:
    """What a gear carries, the mean of what drives and what resists: `moved` is by all of it."""
    return np.abs(u - 0.5 * moved / gain)


def _lost(w: Any, free: Any, gain: Any, u: Any, c: Any, dt: Any, parts: int = PARTS) -> Any:
    return dry(w, free, gain, c["c"], c["b"], c["width"], parts)


def _load(w: Any, free: Any, gain: Any, u: Any, c: Any, dt: Any, parts: int = PARTS) -> Any:
    carried = _carried(free - w, gain, u)
    return dry(w, free, gain, c["c"] + c["k"] * carried, c["b"], c["width"], parts)


def _loaded(site: Site) -> tuple[Quantity, ...]:
    constant, viscous, constant_width = _friction(site)
    share = tuple(float(k) for k in np.geomspace(0.02, 0.6, 6))
    k = Quantity("k", "1", share, 0.02, 0.9, places=4)
    return (constant, viscous, k, constant_width)


def alone(model: Model, tau: str, w: str) -> bool:
    """Whether tau moves nothing but w, and always as much: through a constant inertia."""
    dt, (x, u) = places.probe(model, 1e-5), places.samples(model, 8)
    _, f_u = model.system.linearise(x, u, model.values, dt)
    by, i = f_u[:, :, model.input_names.index(tau)], model.state_names.index(w)
    others = np.abs(np.delete(by, i, axis=1)).max(initial=0.0)
    return bool(others < ONLY * by[0, i] and np.ptp(by[:, i]) < ONLY * by[0, i])


GAINS = ("input_gain", "rate_gain", "added_inertia")


def like_a_load(model: Model, names: Collection[str]) -> bool:
    """Whether two at least of these effects change the inertia of joints that share one.

    Each alone is a gear, a motor. What an arm carries, or a link's mass that is off, is in all of
    the inertia matrix and in gravity: without a parameter for it, gains stand in its place. Where
    an uncertain parameter changes the inertia, that was free beside them: they are what they say.
    """
    gains = {name for name in names if name.partition(":")[0] in GAINS}
    if len(gains) < 2 or _uncertain_inertia(model):
        return False
    coupled = [pair.split("<-") for pair in pairs_of(model)]
    coupled = [pair for pair in coupled if not alone(model, *pair)]
    said = {f"input_gain:{tau}" for tau, _ in coupled} | {f"rate_gain:{w}" for _, w in coupled}
    said |= {f"added_inertia:{tau}<-{w}" for tau, w in coupled}
    return len(said & gains) > 1


def _uncertain_inertia(model: Model) -> bool:
    """Whether an uncertain parameter, be it zero, changes what inputs accelerate."""
    dt, (x, u) = places.probe(model, 1e-2), places.samples(model, 8)

    def pushes(values: Array) -> Array:
        return np.asarray(model.system.linearise(x, u, values, dt)[1])

    before, spreads = pushes(model.values), [p.spread for p in model.params.values()]
    moved = [step for step in np.diag(SOME * np.array(spreads)) if step.any()]
    most = ONLY * SOME * np.abs(before).max()
    return any(np.abs(pushes(model.values + step) - before).max() > most for step in moved)


def renamed(model: Model) -> dict[str, str]:
    """Names that a joint has already where its inertia is constant: {dropped: kept}."""
    found: dict[str, str] = {}
    for pair in pairs_of(model):
        tau, _, w = pair.partition("<-")
        if alone(model, tau, w):
            found |= {f"joint_friction:{pair}": f"coulomb_friction:{w}"}
            found |= {f"added_inertia:{pair}": f"rate_gain:{w}"}
    return found


def one_friction(one: Effect, other: Effect) -> bool:
    """Whether both describe the friction, dry or viscous, of one motion: no model has it twice."""
    (a, of), (b, at) = ((e.family.name, e.site.target.rpartition("<-")[2]) for e in (one, other))
    joints = {joint_friction.name, load_friction.name}
    if of == at and "viscous_friction" in (a, b) and joints & {a, b}:
        return any(q.name == "b" for e in (one, other) for q in e.free)
    return {a, b} <= joints | {"coulomb_friction"} and of == at


joint_friction = LossFamily(
    name="joint_friction",
    equation="u_eff = u - c sign(w) - b w   (u<-w)",
    sentence="{driven} loses [{c} to dry friction & {b} times {source} to viscous friction]",
    targets=pairs_of,
    quantities=_friction,
    lookalikes=("coulomb_friction", "viscous_friction", "dead_zone", "stiction", "parameter"),
    loss=_lost,
    early=partial(_lost, parts=1),
    torque=lambda w, rate, gain, u, c: c["c"] * np.tanh(w / c["width"]) + c["b"] * w,
)

load_friction = LossFamily(
    name="load_friction",
    equation="u_eff = u - (c + k |u - u_load| / 2) sign(w) - b w   (u<-w)",
    sentence="{driven} loses {c} and {k%} of what its gear carries to dry friction[, and {b} times "
    "{source} to viscous friction]",
    targets=pairs_of,
    quantities=_loaded,
    lookalikes=("joint_friction", "coulomb_friction", "viscous_friction", "input_gain"),
    loss=_load,
    early=partial(_load, parts=1),
    torque=lambda w, rate, gain, u, c: (
        (c["c"] + c["k"] * _carried(rate, gain, u)) * np.tanh(w / c["width"]) + c["b"] * w
    ),
)

added_inertia = LossFamily(
    name="added_inertia",
    equation="u_eff = u - J w'   (u<-w)",
    sentence="{driven} moves an inertia of {J} more than modelled (a rotor, a gear, a load)",
    targets=pairs_of,
    quantities=lambda site: (Quantity("J", _per_acceleration(site)),),
    lookalikes=("input_gain", "rate_gain", "parameter"),
    loss=_inertia,
    early=_inertia,
    torque=lambda w, rate, gain, u, c: c["J"] * rate,
)

FAMILIES = (joint_friction, load_friction, added_inertia)
