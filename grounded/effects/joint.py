"""Losses of an input to the motion that it drives: friction, inertia and stiffness of a joint.

    u_eff = u - T(w),      target `tau<-w`: the input tau, and the velocity w that it drives
    u_eff = u - k q - b,   target `tau<-q`: the same of a spring, and the joint's position q

A joint's friction is a torque. Through the inertia matrix, M(q)^-1 T, it acts on all accelerations,
not only on the joint's own. So it is subtracted where the model's own torque enters, and needs only
the model's step, be it NumPy, MuJoCo or any black box. `losses` solves for it within a step.

If tau drives w alone through a constant inertia, the friction equals a Coulomb and a viscous
friction of w, an added inertia equals a gain of its rate, and a spring equals a coupling of w with
the position. These names are used then (`renamed`).

Pairs are found from the model: tau always pushes w in the same direction. (This holds for a torque
and its own joint's velocity, since diagonals of the inverse inertia matrix are positive; elements
off the diagonal change sign.) A wheel turns with several velocities of the model at once, and has
the target `tau<-w+w2` (`drive`).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from grounded import places
from grounded.effects.drive import combined_speeds, motion_of, speed_weights
from grounded.effects.family import Effect, LossFamily, Quantity, Site, coupled, width
from grounded.effects.losses import PARTS, dry
from grounded.frozen import Array
from grounded.model import Model

ALIKE = 0.999  # cosine from which two slopes are equivalent
ONLY = 2e-3  # relative response of other states below which an input drives one speed alone
TURNS = 4  # factor on the number of samples for positions over their whole range
FORCES = ("N", "V", "A")  # first letters of the units of efforts: N m, V ...


def _friction(site: Site) -> tuple[Quantity, ...]:
    tau, w = coupled(site)
    unit, most = site.unit(tau), strongest(site)
    by = f"{unit} s/{site.unit(w).removesuffix('/s')}".removeprefix("1 ")
    viscous = Quantity("b", by, low=0.0, fixed=has_viscous(site.model, site.joined))
    return (Quantity("c", unit, low=0.0, high=most), viscous, width(site, w))


def per_acceleration(site: Site) -> str:
    """Return the unit of an inertia: kg m^2 for N m and rad/s, kg for N and m/s, or a fraction."""
    tau, w = (site.unit(name) for name in coupled(site))
    other = f"{tau} s^2/{w.removesuffix('/s')}".removeprefix("1 ")
    return {"N m": "kg m^2", "N": "kg"}.get(tau, other)


def has_viscous(model: Model, target: str) -> bool:
    """Check whether uncertain parameters already describe viscous friction.

    That is the case if k w d f / d tau = d f / d p for one of them, or for a combination: a motor's
    gain K and time constant T in w' = (K u - w) / T can imitate any viscous friction. Constants (a
    back-EMF from the data sheet) don't count, since they are not fitted.
    """
    tau, weights = target.partition("<-")[0], speed_weights(model, target)
    uncertain = [i for i, p in enumerate(model.params.values()) if p.spread > 0]
    dt, (x, u) = places.probe(model, 1e-4), places.samples(model, 8 * (1 + len(uncertain)))
    _, f_u, f_p = model.system.sensitivities(x, u, model.values, dt)
    speed = np.stack([k * x[:, model.state_names.index(w)] for w, k in weights.items()]).sum(axis=0)
    ours = (f_u[:, :, model.input_names.index(tau)] * speed[:, None]).reshape(-1)
    theirs = f_p.reshape(len(ours), -1)
    known = [i for i in uncertain if theirs[:, i].any()]
    if not known:
        return False
    sets = [[i] for i in known] + [known]
    axes = [np.linalg.qr(theirs[:, some])[0] for some in sets]
    alike = max(float(np.sum((each.T @ ours) ** 2)) for each in axes)
    return bool(alike > ALIKE**2 * float(np.sum(ours**2)) > 0)


def strongest(site: Site) -> float:
    """Return twice the largest input seen, which bounds dry friction; infinite without a motor."""
    tau, _ = coupled(site)
    return 2 * site.scales.peak(tau) if site.scales.moves(tau) else np.inf


def pairs_of(model: Model) -> list[str]:
    """Return `tau<-w` for every effort and the velocity that it always pushes the same way.

    Efforts are inputs in N, N m, V or A; of a simulator, also inputs without a unit; and any input
    that moves several velocities through an inertia. A drive whose speed is a combination of
    velocities, such as a wheel's, has all of them: `left<-v+yaw_rate`.
    """
    own, units = getattr(model.step, "timestep", 0.0), model.inputs.items()
    efforts = [n for n, unit in units if unit.startswith(FORCES) or (own and unit == "1")]
    if own and not efforts:
        efforts = list(model.input_names)
    velocities = places.velocities(model)
    found = {}
    if efforts and velocities:
        f_u = places.slopes(model).u
        found = {tau: _pushed(model, f_u, tau, velocities) for tau in efforts}
    if not own and len(found) < model.m:
        found |= _coupled(model, [n for n in model.input_names if n not in found])
    units_of = ("1", *FORCES)
    for tau, speeds in combined_speeds(model).items():
        if model.inputs[tau].startswith(units_of):
            found[tau] = "+".join(speeds)
    return [f"{tau}<-{found[tau]}" for tau in model.input_names if found.get(tau)]


def _pushed(model: Model, f_u: Array, tau: str, velocities: Sequence[str]) -> str | None:
    """Return the velocity that an input pushes most strongly in a constant direction, or None."""
    by = {w: f_u[:, model.state_names.index(w), model.input_names.index(tau)] for w in velocities}
    least = {w: float(g.min()) for w, g in by.items() if g.min() > 1e-9}
    return max(least, key=lambda w: least[w], default=None)


def _coupled(model: Model, inputs: Sequence[str]) -> dict[str, str | None]:
    """Return the velocity driven by inputs of any unit that also move a second velocity.

    Diagonals of an inverse inertia matrix are positive for all positions q' = w: an input whose
    direction changes with them (a tilted thrust) is not a joint's motor.
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
            found[tau] = None  # coulomb_friction:w is equivalent
    return found


def _inertia(w: Any, free: Any, gain: Any, u: Any, c: Any, dt: Any) -> Any:
    wanted = c["J"] / dt
    return wanted * (free - w) / np.maximum(1 + gain * wanted, 0.1)


def _carried(moved: Any, gain: Any, u: Any) -> Any:
    """Return the load of a gear, the mean of drive and resistance; `moved` is the net effect."""
    return np.abs(u - 0.5 * moved / gain)


def _lost(w: Any, free: Any, gain: Any, u: Any, c: Any, dt: Any, parts: int = PARTS) -> Any:
    return dry(w, free, gain, c["c"], c["b"], c["width"], parts)


def _load(w: Any, free: Any, gain: Any, u: Any, c: Any, dt: Any, parts: int = PARTS) -> Any:
    carried = _carried(free - w, gain, u)
    return dry(w, free, gain, c["c"] + c["k"] * carried, c["b"], c["width"], parts)


def _loaded(site: Site) -> tuple[Quantity, ...]:
    constant, viscous, constant_width = _friction(site)
    k = Quantity("k", "1", np.geomspace(0.02, 0.6, 6), 0.02, 0.9, places=4)
    return (constant, viscous, k, constant_width)


def alone(model: Model, tau: str, w: str) -> bool:
    """Check whether tau moves only w, through a constant inertia."""
    f_u = places.slopes(model, places.INSTANT_S).u
    by, i = f_u[:, :, model.input_names.index(tau)], model.state_names.index(w)
    others = np.abs(np.delete(by, i, axis=1)).max(initial=0.0)
    return bool(others < ONLY * by[0, i] and np.ptp(by[:, i]) < ONLY * by[0, i])


def renamed(model: Model) -> dict[str, str]:
    """Return effects of a joint with constant inertia that are equivalent: {dropped: kept}."""
    found: dict[str, str] = {}
    springs = dict(pair.split("<-") for pair in springs_of(model))
    for pair in pairs_of(model):
        tau, _, w = pair.partition("<-")
        if "+" not in w and alone(model, tau, w):
            found |= {f"joint_friction:{pair}": f"coulomb_friction:{w}"}
            found |= {f"added_inertia:{pair}": f"rate_gain:{w}"}
            if q := springs.get(tau):
                found[f"joint_spring:{tau}<-{q}"] = f"coupling:{w}<-{q}"
    return found


def one_friction(one: Effect, other: Effect) -> bool:
    """Check whether two effects describe the same friction (dry or viscous) of one motion."""
    (a, of), (b, at) = ((e.family.name, motion_of(e)) for e in (one, other))
    joints = {joint_friction.name, load_friction.name}
    if of == at and "viscous_friction" in (a, b) and joints & {a, b}:
        return any(q.name == "b" for e in (one, other) for q in e.free)
    return {a, b} <= joints | {"coulomb_friction", "dahl_friction"} and of == at


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
    sentence="{driven} loses {c} plus {k%} of the load on its gear to dry friction[, and {b} times "
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


def springs_of(model: Model) -> list[str]:
    """Return `tau<-q` for every effort and the position of the joint that it drives."""
    axes = places.integrated(model)
    positions = {w: [q for q, (speed, _) in axes.items() if speed == w] for w, _ in axes.values()}
    pairs = (pair.split("<-") for pair in pairs_of(model))  # of a wheel, none
    return [f"{tau}<-{positions[w][0]}" for tau, w in pairs if len(positions.get(w, ())) == 1]


def _stiffness(site: Site) -> tuple[Quantity, ...]:
    tau, q = coupled(site)
    return (Quantity("k", f"{site.unit(tau)}/{site.unit(q)}"), Quantity("b", site.unit(tau)))


def _pull(q: Any, free: Any, gain: Any, u: Any, c: Any, dt: Any) -> Any:
    """Return the mean of k q + b over a step that would end at the position `free`."""
    return (0.5 * c["k"] * (q + free) + c["b"]) / np.maximum(1 + 0.5 * c["k"] * gain, 0.1)


joint_spring = LossFamily(
    name="joint_spring",
    equation="u_eff = u - k q - b   (u<-q)",
    sentence="a spring (a cable, a flexure, a hose) pulls {source} back by {k} of {driven}, "
    "and {b} where it is 0",
    targets=springs_of,
    quantities=_stiffness,
    lookalikes=("coupling", "input_bias", "parameter"),
    loss=_pull,
    early=_pull,
    torque=lambda q, rate, gain, u, c: c["k"] * q + c["b"],
)

added_inertia = LossFamily(
    name="added_inertia",
    equation="u_eff = u - J w'   (u<-w)",
    sentence="{driven} moves an inertia of {J} {J>more than modelled (a rotor, a gear, a load)|"
    "less than modelled}",
    targets=pairs_of,
    quantities=lambda site: (Quantity("J", per_acceleration(site)),),
    lookalikes=("input_gain", "rate_gain", "parameter"),
    loss=_inertia,
    early=_inertia,
    torque=lambda w, rate, gain, u, c: c["J"] * rate,
)

FAMILIES = (joint_friction, load_friction, added_inertia, joint_spring)
