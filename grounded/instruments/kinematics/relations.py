"""Kinematic relations between sensors that hold whatever the physics, derived from the model.

    a state whose rate is c times another state        q' = c w
    two states whose rates rotate with a third         (x', y') = R(psi) (v_x, v_y)

The first relates an angle to its angular velocity and shows delays, signs and units. The second
relates a heading and a speed to the course travelled. Side slip and wheel slip act there as well,
so only errors that no physics causes are corrected: a mirrored heading, or one in degrees.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded import places
from grounded.frozen import Array, wrapped
from grounded.instruments.finding import Finding
from grounded.instruments.lag import SURE, Lag, lag_between
from grounded.model import Model
from grounded.places import Integral, integrals, true_values
from grounded.trial import Trial, stretches

SHORT = 1e-6  # [s] time step from which the rates are computed
FAST = 0.2  # of the largest speed: below it the course is too noisy
OWN = 200  # logged samples from which the model's own lag is computed
COPIED = 1e-3  # of a velocity: rounding of a log; a separate sensor would differ by more
AGREE = 0.9  # length of the mean unit vector above which directions agree
TURNED_AWAY = np.deg2rad(20)  # more than any side slip causes
OFF = 0.03  # scale error that is reported, beyond both of its bounds
SAME_WAY = 0.95  # coherence of speed and distance: below it something drifts or slips


def late_by_the_model(model: Model, shown: Sequence[int]) -> dict[int, int]:
    """Return the memory states with true values, {its index: that of the state that logs it}."""
    names = model.state_names
    return true_values(names, [name for i, name in enumerate(names) if i not in shown])


def logged_behind(model: Model, shown: Sequence[int]) -> list[tuple[Integral, bool]]:
    """Return the relations between logged states whose true values are in memory states.

    Adopted sensor effects (delays, filters) keep the true value of a state as memory. Each relation
    comes with whether both of its states are delayed.
    """
    log = late_by_the_model(model, shown)
    return [
        (replace(one, i=log.get(one.i, one.i), j=log.get(one.j, one.j)), {one.i, one.j} <= {*log})
        for one in integrals(model)
        if one.exact and not {one.i, one.j}.isdisjoint(log)
        if {log.get(k, k) for k in (one.i, one.j)} <= {*shown}
    ]


def lag_of(model: Model, relation: Integral, trials: Sequence[Trial]) -> Lag | None:
    """Return delay and scale of a logged velocity against the rate of its logged position."""
    dt, pairs = trials[0].dt, []
    for piece in pieces(trials, (relation.i, relation.j)):
        moved = np.diff(piece[:, 0])[:, None]
        wrapped(moved, [model.angle_mask[relation.i]])
        w = relation.c * piece[:, 1]
        pairs.append((moved[1:-1, 0] / dt, over_steps(w)))
    return lag_between(pairs, dt)


def own_lag(model: Model, relation: Integral, trials: Sequence[Trial]) -> float:
    """Return the delay of a velocity behind its position's rate in the model itself [s].

    It is evaluated at logged samples. A simulator that moves a position by the velocity before or
    after a step has a lag of half a step, which is not a sensor's.
    """
    dt, (i, j, c) = trials[0].dt, (relation.i, relation.j, relation.c)
    x = np.concatenate([trial.states[:-1] for trial in trials])
    u = np.concatenate([trial.inputs for trial in trials])
    known = np.isfinite(x[:, [i, j]]).all(axis=1) & np.isfinite(u).all(axis=1)
    at = np.flatnonzero(known)[:: max(1, int(known.sum()) // OWN)]
    if not len(at):
        return 0.0
    before = np.nan_to_num(x[at], nan=0.0)  # states without a sensor
    after = model.system.step(before, u[at], model.values, dt)
    changed = c * (after[:, j] - before[:, j])
    moved = model.difference(after, before)[:, i] / dt - c * (after[:, j] + before[:, j]) / 2
    size = float(changed @ changed)
    late = float(moved @ changed) / size * dt if size > 0 else 0.0
    return late if np.isfinite(late) and abs(late) < dt else 0.0


def differenced(model: Model, relation: Integral, trials: Sequence[Trial]) -> bool:
    """Check whether the velocity is the difference of its position's samples over one step.

    False where the model itself moves the position by exactly that velocity.
    """
    dt, rests, sizes = trials[0].dt, np.zeros(2), np.zeros(2)
    for piece in pieces(trials, (relation.i, relation.j)):
        moved = np.diff(piece[:, 0])[:, None]
        wrapped(moved, [model.angle_mask[relation.i]])
        w = relation.c * piece[:, 1]
        for k, known in enumerate((w[1:], w[:-1])):  # at the end of the step, at its start
            rests[k] += ((moved[:, 0] / dt - known) ** 2).sum()
            sizes[k] += (known**2).sum()
    copies = (rests < COPIED**2 * sizes) & (sizes > 0)
    if not copies.any():
        return False
    late = (0.5 if copies[0] else -0.5) * dt
    return abs(own_lag(model, relation, trials) - late) > 0.25 * dt


def over_steps(w: Array) -> Array:
    """Return the mean of w (T,) over each step but the first and the last (T - 3,), by cubics."""
    return (13 * (w[1:-2] + w[2:-1]) - w[:-3] - w[3:]) / 24


def pieces(trials: Sequence[Trial], columns: Sequence[int]) -> Iterator[Array]:
    """Yield the stretches (T, columns) of the states that have no gaps."""
    for trial in trials:
        some = trial.states[:, list(columns)]
        good = np.isfinite(some).all(axis=1)
        yield from (some[a:b] for a, b in stretches(np.asarray(good)) if b - a > 4)


@dataclass(frozen=True)
class Turned:
    """The rates of states i and j rotate with heading k; their size depends on states `speed`."""

    i: int
    j: int
    k: int
    speed: tuple[int, ...]


def turned(model: Model) -> Turned | None:
    """Return the plane in which a model moves; None if it has none."""
    (x, u), n = places.samples(model, 8), model.n
    short = places.probe(model, SHORT)
    f_x, f_u = model.system.linearise(x, u, model.values, short)
    rates = (model.system.step(x, u, model.values, short) - x) / short
    slopes = (f_x - np.eye(n)) / short
    free = [i for i in range(n) if np.abs(f_u[:, i]).max() < 1e-9 and np.abs(rates[:, i]).max() > 0]
    for i in free:
        for j in free:
            for k in range(n):
                if k in (i, j) or i == j:
                    continue
                if _near(slopes[:, i, k], -rates[:, j]) and _near(slopes[:, j, k], rates[:, i]):
                    along = (rates[:, [i, j], None] * slopes[:, [i, j]]).sum(axis=1)
                    size = np.abs(along).max(axis=0) > 1e-6
                    return Turned(i, j, k, tuple(int(s) for s in np.flatnonzero(size) if s != k))
    return None


def _near(a: Array, b: Array) -> bool:
    return bool(np.abs(a - b).max() < 1e-3 * max(float(np.abs(b).max()), 1e-9))


@dataclass(frozen=True)
class Course:
    """The course travelled, compared with the model's course from logged heading and speed.

    Args:
        agrees: agreement of the directions apart from a constant angle, 0 to 1.
        offset: that angle [rad].
        mirrored: the agreement with the sign of the heading reversed.
        degrees: the agreement with the heading interpreted as degrees.
        speed: delay and scale of the model's speed against the speed travelled.
    """

    agrees: float
    offset: float
    mirrored: float
    degrees: float
    speed: Lag | None


def course(model: Model, relation: Turned, trials: Sequence[Trial]) -> Course | None:
    """Compare how the logged positions move with what the logged heading and speed imply.

    Returns:
        None if too few samples move fast enough.
    """
    dt, columns, short = trials[0].dt, range(model.n), places.probe(model, SHORT)
    xy = [relation.i, relation.j]
    ways = [(one, np.diff(one[:, xy], axis=0) / dt) for one in pieces(trials, columns)]
    if not ways:
        return None
    way = np.concatenate([moved for _, moved in ways])
    speeds = np.hypot(*way.T)
    fast = speeds > FAST * float(np.quantile(speeds, 0.98))
    if fast.sum() < 20:
        return None

    def said(factor: float) -> list[Array]:
        """Return the model's velocity at the middle of each step, the heading times a factor."""
        found = []
        for piece, _ in ways:
            middle = 0.5 * (piece[1:] + piece[:-1])
            middle[:, relation.k] *= factor
            u = np.zeros((len(middle), model.m))
            rates = (model.system.step(middle, u, model.values, short) - middle) / short
            found.append(rates[:, xy])
        return found

    angle = np.arctan2(way[:, 1], way[:, 0])[fast]

    def mean(factor: float) -> complex:
        x, y = np.concatenate(said(factor))[fast].T
        return complex(np.exp(1j * (angle - np.arctan2(y, x))).mean())

    plain = mean(1.0)
    pairs = []
    for (_, moved), rate in zip(ways, said(1.0), strict=True):
        along = np.hypot(*rate.T)
        unit = rate / np.maximum(along, 1e-12)[:, None]
        pairs.append(((moved * unit).sum(axis=1), along))
    return Course(
        abs(plain),
        float(np.angle(plain)),
        abs(mean(-1.0)),
        abs(mean(np.pi / 180)),
        lag_between(pairs, dt) if abs(plain) > AGREE else None,
    )


def travelled(
    model: Model, trials: Sequence[Trial], shown: Sequence[int]
) -> tuple[Turned, Course] | None:
    """Return the plane in which a model moves, and the course there; None without sensors for it.

    Args:
        model: however crude.
        trials: of this model's states.
        shown: indices of the states with a sensor.
    """
    relation = turned(model)
    if relation is None or not {relation.i, relation.j, relation.k} <= set(shown):
        return None
    found = course(model, relation, trials)
    return None if found is None else (relation, found)


def judge_speed(model: Model, relation: Turned, lag: Lag | None, dt: float) -> Iterator[Finding]:
    """Yield findings of a delayed or wrongly scaled speed.

    They are not corrected: wheel slip and drift look the same, so the identification decides.

    Args:
        model: with this plane.
        relation: the plane; a body that also moves sideways is skipped, since noise biases the
            length of its velocity.
        lag: of the speed behind the motion, see `Course.speed`.
        dt: time step [s].
    """
    if lag is None or lag.coherence < SAME_WAY or lag.sign < 0 or len(relation.speed) != 1:
        return
    where = "+".join(model.state_names[i] for i in (relation.i, relation.j))
    d, name = float(abs(lag.delay)), model.state_names[relation.speed[0]]
    if d > max(SURE * lag.std, 0.5 * dt):
        text = f"{d:.3g} s {'later' if lag.delay > 0 else 'earlier'} than the motion of {where}"
        yield Finding(name, text, "delay", float(lag.delay), lag.std)
    if lag.off(OFF):
        text = f"shows {100 * lag.scale:.3g} % of the speed of {where}: a sensor error, or slip"
        yield Finding(name, text, "scale", scale=lag.scale)
