"""The states and inputs of a model by their meaning: where effects act, what sensors relate.

Roles come from the model (`Model.roles`). Without roles, a position is a pair of states called x
and y (or north and east), a heading is an angle called psi, yaw, heading or theta (beside such a
pair any state in rad of these names, whether declared an angle or not), and a speed is a state
called v or speed. A velocity is any state whose unit is per second; friction acts on those.
Effects whose targets can't be determined are not candidates.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from grounded.frozen import Array
from grounded.model import Model, is_clock

POSITIONS = (("x", "y"), ("north", "east"), ("px", "py"), ("pos_x", "pos_y"))
HEADINGS = ("psi", "yaw", "heading", "theta")
INSTANT_S = 1e-5  # step for instantaneous rates [s]
STRAIGHT = 1e-3  # error of velocities of about 1 from such a step
MOVES_STATE = 1e-3  # part of what an input moves most below which it does not move a state
SLOPE = 0.01  # tolerance of the factor 1 in q' = w
SPEEDS = ("v", "speed", "velocity", "vx", "u")
MODELS_KEPT = 64  # models of which is remembered what was found


def role(model: Model, name: str) -> tuple[str, ...]:
    """Return the states with a role, () if the model declares none."""
    found = model.roles.get(name, ())
    return (found,) if isinstance(found, str) else tuple(found)


def inputs(model: Model) -> Sequence[str]:
    """Return every input."""
    return model.input_names


def states(model: Model) -> Sequence[str]:
    """Return every state."""
    return model.state_names


def position(model: Model) -> tuple[str, ...]:
    """Return the states of a position on the ground (two of them, or one along an axis)."""
    named = role(model, "position")
    if named:
        return named[:2]
    return next((p for p in POSITIONS if set(p) <= set(model.state_names)), ())


def heading(model: Model) -> str | None:
    """Return the state of the heading, or None."""
    declared = [h for h in HEADINGS if h in model.angles]
    other = [h for h in HEADINGS if model.states.get(h) == "rad" and len(position(model)) == 2]
    return next(iter((*role(model, "heading"), *declared, *other)), None)


def speed(model: Model) -> str | None:
    """Return the state of the speed along the heading, or None."""
    named = (*role(model, "speed"), *(s for s in SPEEDS if s in model.state_names))
    return next(iter(named), None)


@lru_cache(maxsize=8)  # asked by several families of effects
def of_a_kind(model: Model) -> tuple[tuple[str, ...], ...]:
    """Return the groups of inputs with drives of one kind, as far as the model tells.

    Their unit is the same. If that is 1, which says nothing, so are the units of the states that
    they move: two thrusters are alike, a car's steering and its throttle are not.
    """
    if model.m < 2:
        return ()
    bare = direct(model)
    by, units = np.abs(slopes(bare, INSTANT_S).u).max(axis=0), list(bare.states.values())
    kinds: dict[tuple[str, ...], list[str]] = {}
    for j, name in enumerate(model.input_names):
        moved = {units[i] for i in np.flatnonzero(by[:, j] > MOVES_STATE * by[:, j].max())}
        unit = model.inputs[name]
        kinds.setdefault((unit, *(sorted(moved) if unit == "1" else ())), []).append(name)
    return tuple(tuple(found) for found in kinds.values() if len(found) > 1)


def speed_input(model: Model) -> str | None:
    """Return the input that commands the speed, found by its name and unit, or None."""
    return next((n for n in SPEEDS if n in model.input_names and model.inputs[n] == "m/s"), None)


def steering(model: Model) -> list[str]:
    """Return what turns the heading: steering angles among the states, or inputs.

    The speed is left out, since it turns the heading only together with these.
    """
    turned = heading(model)
    if turned is None:
        return []
    f_x, f_u, dt = slopes(model, INSTANT_S)
    by = np.abs(np.concatenate([f_x, f_u], axis=2)).max(axis=0)[model.state_names.index(turned)]
    size = dict(zip((*model.state_names, *model.input_names), by.tolist(), strict=True))
    no = {*position(model), turned, speed(model), speed_input(model), *role(model, "heading_rate")}
    return [n for n, by in size.items() if n not in no and by > 1e-3 * dt]


def body_velocity(model: Model) -> tuple[str, ...]:
    """Return the body velocities (u, v), ahead and to the side, or () if a model lacks them.

    They are found from the model's rates: x' = u cos psi - v sin psi, y' = u sin psi + v cos psi.
    """
    where, turned, model = position(model), heading(model), motion(model)
    if len(where) < 2 or turned is None:
        return ()
    (x, u), dt, names = samples(model, 8), probe(model, INSTANT_S), model.state_names
    rates = (model.system.step(x, u, model.values, dt) - x) / dt
    i, j, k = (names.index(name) for name in (*where, turned))
    cos, sin = np.cos(x[:, k]), np.sin(x[:, k])
    own = rates[:, i] * cos + rates[:, j] * sin, rates[:, j] * cos - rates[:, i] * sin
    found = [[n for n in range(model.n) if np.abs(x[:, n] - one).max() < STRAIGHT] for one in own]
    return tuple(names[one[0]] for one in found) if all(found) else ()


def velocities(model: Model) -> list[str]:
    """Return the states whose unit is per second: linear or angular velocities."""
    return [n for n, u in model.states.items() if u.endswith("/s") or u.endswith("/ s")]


def but_position(model: Model) -> list[str]:
    """Return every state that is not a position."""
    return [n for n in model.state_names if n not in position(model)]


def plane(model: Model) -> list[str]:
    """Return [`x+y`] for a model that moves in the plane with a heading, else []."""
    where = position(model)
    if len(where) == 2 and heading(model):
        return ["+".join(where)]
    return []


def dynamic(model: Model) -> list[str]:
    """Return the states other than position and heading, which forces and actuators drive."""
    still = {*position(model), *([heading(model)] if heading(model) else [])}
    rest = [n for n in model.state_names if n not in still]
    return rest or list(model.state_names)


def pairs(model: Model) -> list[str]:
    """Return `target<-source` for every state but positions, with dynamic states as sources."""
    names = dynamic(model)
    return [f"{t}<-{s}" for t in but_position(model) for s in names if s != t]


def crossed(model: Model) -> list[str]:
    """Return `target<-input` for every state that some input drives at once, and every other input.

    An input that acts on a state through others in between (a servo) does not drive it at once.
    """
    _, f_u, dt = slopes(model, INSTANT_S)
    acts = dict(zip(model.state_names, np.abs(f_u).max(axis=0) > 1e-3 * dt, strict=True))
    driven = [name for name in dynamic(model) if acts[name].any()]
    return [
        f"{name}<-{a}"
        for name in driven
        for a, own in zip(model.input_names, acts[name], strict=True)
        if not own
    ]


def samples(model: Model, count: int = 3) -> tuple[Array, Array]:
    """Return random states (count, n) and inputs (count, m), the same ones every time."""
    rng = np.random.default_rng(0)
    x = rng.uniform(0.2, 1.0, (count, model.n))
    return x, rng.uniform(0.2, 1.0, (count, model.m))


def within_limits(model: Model, count: int = 3) -> tuple[Array, Array]:
    """Return samples, and the same with small inputs, within limits that a model has of its own."""
    x, u = samples(model, count)
    return np.concatenate([x, x]), np.concatenate([u, 0.01 * u])


def probe(model: Model, dt: float) -> float:
    """Return a step for probing a model [s]: dt, or the nearest that its simulator supports."""
    own = float(getattr(model.step, "timestep", 0.0))
    return max(1, round(dt / own)) * own if own else dt


class Slopes(NamedTuple):
    """Slopes of a step of dt [s] at random states and inputs (`samples`): (S, n, n), (S, n, m)."""

    x: Array
    u: Array
    dt: float


@lru_cache(maxsize=MODELS_KEPT)
def slopes(model: Model, step: float = 1e-2) -> Slopes:
    """Return the slopes of a model's step of about so many seconds (`probe`)."""
    dt = probe(model, step)
    return Slopes(*model.system.linearise(*samples(model, 8), model.values, dt), dt)


def direct(model: Model) -> Model:
    """Return the model without adopted effects on its inputs, with the current parameters.

    Its states are the first ones of the model. What an input moves shows in its slopes: a delay, a
    dead zone or a saturation that was adopted would hide it.
    """
    while (around := getattr(model.step, "around", None)) is not None and around.of_inputs:
        model = _within(model, around.inner)
    return model


@lru_cache(maxsize=MODELS_KEPT)
def motion(model: Model) -> Model:
    """Return the model as written, without any adopted effect, with the current parameters.

    Which velocities move a position is a matter of its geometry: a drift over the ground or a late
    log that was adopted would hide it.
    """
    while (around := getattr(model.step, "around", None)) is not None:
        model = _within(model, around.inner)
    return model


def _within(model: Model, inner: Model) -> Model:
    return replace(inner, params={name: model.params[name] for name in inner.params})


def integrated(model: Model) -> dict[str, tuple[str, float]]:
    """Return states whose rate is c times another state: {angle: (angular velocity, c)}.

    No input moves such a rate, at once or late. For a simulator with a fixed time step, the rate
    is the velocity after the step.
    """
    model = direct(model)
    (x, u), dt = within_limits(model), probe(model, 1e-8)
    after = model.system.step(x, u, model.values, dt)
    moved, names, found = (after - x) / dt, model.state_names, {}
    if dt > INSTANT_S:
        for i, name in enumerate(names):
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = moved[:, [i]] / after
            same = np.isfinite(ratio).all(axis=0) & (np.ptp(ratio, axis=0) < 1e-6 * abs(ratio[0]))
            for j in map(int, np.flatnonzero(same)):
                if j != i:
                    found[name] = names[j], float(ratio[0, j])
        return found
    f_x, f_u = model.system.linearise(x, u, model.values, dt)
    rates = (f_x - np.eye(model.n)) / dt
    for i, name in enumerate(names):
        j = int(np.argmax(np.abs(rates[0, i])))
        c = rates[0, i, j]
        small = 1e-4 * abs(c)
        alone = np.abs(np.delete(rates[:, i], j, axis=1)).max(initial=0.0) < small
        steady = np.abs(rates[:, i, j] - c).max() < small and np.abs(f_u[:, i]).max() / dt < small
        straight = np.allclose(moved[:, i], c * x[:, j], rtol=1e-4)
        if i != j and c != 0 and alone and steady and straight:
            found[name] = names[j], float(np.mean(moved[:, i] / x[:, j]))
    return found


def only_read(model: Model) -> dict[str, str]:
    """Return states that only integrate another one, on which nothing depends: {stick: its rate}.

    Such a state changes slower than modelled if its sensor reads too little, or if a gear between
    the two is another one. No trial tells which.
    """
    pairs = integrated(model)
    if not pairs:
        return {}
    change = slopes(model).x - np.eye(model.n)
    felt = np.abs(change).max(axis=0).max(axis=0)  # by any state, itself included
    free = {name for name, size in zip(model.state_names, felt, strict=True) if size < 1e-9}
    return {name: rate for name, (rate, _) in pairs.items() if name in free}


def levelled(model: Model) -> list[str]:
    """Return angles and positions that act on one velocity alone.

    A balance's angle acts on its own, a beam's on that of the ball. Gravity or a spring that acts
    about another angle than the model's then looks in every log like a sensor with another zero.
    """
    (f_x, _, dt), found = slopes(model, 1e-6), []
    felt = (np.abs(f_x - np.eye(model.n)) / dt).max(axis=0)
    places = integrated(model)
    rates = [model.state_names.index(rate) for rate, _ in places.values()]
    for name in places:
        column = felt[:, model.state_names.index(name)]
        most = int(np.argmax(column))
        others = np.delete(column, most).max(initial=0.0)
        if most in rates and others < 1e-4 * column[most]:
            found.append(name)
    return found


@dataclass(frozen=True)
class Integral:
    """The rate of state i is c times state j; `exact` if the model says so, not only its roles."""

    i: int
    j: int
    c: float
    exact: bool = True


@lru_cache(maxsize=8)  # each log is read with the same model, which is asked twenty times
def integrals(model: Model) -> tuple[Integral, ...]:
    """Return the pairs of position and velocity, and of angle and rate, of a model.

    A heading rate that the model only carries along is included, with `exact` false.
    """
    names = model.state_names
    found = [
        Integral(names.index(name), names.index(other), c)
        for name, (other, c) in integrated(model).items()
    ]
    carried = [(i, k) for i, n in enumerate(names) if (k := partner(model, n))]
    return (*found, *(Integral(i, names.index(k), 1.0, exact=False) for i, k in carried))


def rate_states(model: Model) -> dict[str, str]:
    """Return the states whose rate is another state of the model: {q: w}."""
    names = model.state_names
    own = [r for r in integrals(model) if r.exact and abs(r.c - 1) < SLOPE]
    return {names[r.i]: names[r.j] for r in own}


def told_by(model: Model, pair: Sequence[str]) -> set[str]:
    """Return the states from which a common delay of the sensors of a pair is identifiable.

    These are coupled to the pair, directly or through an input in common. Without any, a delay of
    the pair is equivalent to a delay of its inputs.
    """
    names = (*model.state_names, *model.input_names)
    by = np.abs(np.concatenate(slopes(model)[:2], axis=2)).max(axis=0)
    tied = np.zeros((len(names), len(names)), bool)
    tied[: model.n] = np.nan_to_num(by) > 1e-9
    tied |= tied.T | np.eye(len(names), dtype=bool)
    found = np.isin(names, pair)
    for _ in names:
        found = np.asarray(tied[found].any(axis=0))
    return {name for name, at in zip(model.state_names, found, strict=False) if at} - set(pair)


def late_together(model: Model) -> list[str]:
    """Return `q+w` for each position and its velocity (q' = c w), which one sensor may give."""
    pairs = [(q, w) for q, (w, _) in integrated(model).items()]
    return ["+".join(pair) for pair in pairs if told_by(model, pair)]


def following(model: Model) -> list[str]:
    """Return states that follow an input: a steering angle, a motor's speed, a servo.

    Their rate depends on an input, on no other state, and somewhere decreases with them.
    """
    (f_x, f_u, _), found = slopes(model), []
    for i, name in enumerate(model.state_names):
        driven = np.abs(f_u[:, i]).max() > 1e-6
        alone = np.abs(np.delete(f_x[:, i], i, axis=1)).max(initial=0.0) < 1e-6
        own = f_x[:, i, i]
        if driven and alone and own.min() < 1 - 1e-6 and np.abs(own).max() > 1e-9:
            found.append(name)
    return [name for name in found if name not in position(model)]


def derived_states(model: Model) -> set[str]:
    """Return heading rates on which nothing depends, carried along only to be measured.

    They have no rate effects of their own; those on the heading change them, too (`partner`).
    """
    named = role(model, "heading_rate")
    if not named:
        return set()
    i = model.state_names.index(named[0])
    others = np.delete(slopes(model).x[:, :, i], i, axis=1)
    return {named[0]} if float(np.abs(others).max()) < 1e-12 else set()


def outright_states(model: Model) -> set[str]:
    """Return states that the model sets regardless of their previous value, without dynamics."""
    own = np.abs(np.diagonal(slopes(model).x, axis1=1, axis2=2)).max(axis=0)
    return {name for name, size in zip(model.state_names, own, strict=True) if size < 1e-9}


def partner(model: Model, target: str) -> str | None:
    """Return the carried heading rate that follows the heading `target`, or None."""
    if target != heading(model):
        return None
    idle = derived_states(model)
    return next(iter(idle), None)


def true_values(names: Sequence[str], memory: Collection[str]) -> dict[int, int]:
    """Return {memory state that holds true values behind a delayed log: state that logs it}.

    By their indices among all names (n,), of which adopted effects added those in `memory`.
    """
    own = [(k, n) for k, n in enumerate(names) if n not in memory]
    return {
        i: k
        for i, name in enumerate(names)
        for k, n in own
        if name in memory and name.startswith(f"{n}_true") and not is_clock(name)
    }
