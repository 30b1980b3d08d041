"""What must hold between sensors whatever the physics is: read off the model, not off names.

    a state whose rate is c times another state        q' = c w
    two states whose rates turn with a third           (x', y') = R(psi) (v_x, v_y)

The first ties an angle to its angular velocity: how late, of which sign, in which unit. The second
ties a heading and a speed to the way that was travelled; a side slip or a slipping wheel acts there
too, so that only what no physics does is put right: a mirrored heading, one in degrees.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.effects import places
from grounded.effects.memory import true_values
from grounded.effects.registry import partner
from grounded.frozen import Array, wrapped
from grounded.instruments.finding import Finding
from grounded.instruments.lag import SURE, Lag, lag_between
from grounded.model import Model
from grounded.trial import Trial, stretches

SHORT = 1e-6  # [s], a step that shows the rates
FAST = 0.2  # of the largest speed: below it a course means little
OWN = 200  # logged samples that show how a model's own position follows its velocity
COPIED = 1e-3  # of a velocity: digits of a log, less than any sensor of its own differs by
AGREE = 0.9  # length of the mean of unit vectors that point the same way
TURNED_AWAY = np.deg2rad(20)  # what no side slip makes
OFF = 0.03  # of a scale, beyond both of its brackets
SAME_WAY = 0.95  # of a speed and the way: below it something drifts or slips


@dataclass(frozen=True)
class Integral:
    """The rate of state i is c times state j; `exact`: by the model itself, not by roles."""

    i: int
    j: int
    c: float
    exact: bool = True


def integrals(model: Model) -> list[Integral]:
    """A position and its velocity, an angle and its rate; a carried heading rate as well."""
    names = model.state_names
    found = [
        Integral(names.index(name), names.index(other), c)
        for name, (other, c) in places.integrated(model).items()
    ]
    carried = [(i, k) for i, n in enumerate(names) if (k := partner(model, n))]
    return found + [Integral(i, names.index(k), 1.0, exact=False) for i, k in carried]


def logged_behind(model: Model, shown: Sequence[int]) -> list[tuple[Integral, bool]]:
    """The same between logs, where adopted effects keep the true values of late ones as memory.

    Each with whether both are late.
    """
    names = model.state_names
    memory = [name for i, name in enumerate(names) if i not in shown]
    log = true_values(names, memory)
    return [
        (replace(one, i=log.get(one.i, one.i), j=log.get(one.j, one.j)), {one.i, one.j} <= {*log})
        for one in integrals(model)
        if one.exact and not {one.i, one.j}.isdisjoint(log)
        if {log.get(k, k) for k in (one.i, one.j)} <= {*shown}
    ]


def lag_of(model: Model, relation: Integral, trials: Sequence[Trial]) -> Lag | None:
    """How a logged velocity stands to the rate of its logged position."""
    dt, pairs = trials[0].dt, []
    for piece in pieces(trials, (relation.i, relation.j)):
        moved = np.diff(piece[:, 0])[:, None]
        wrapped(moved, [model.angle_mask[relation.i]])
        w = relation.c * piece[:, 1]
        pairs.append((moved[1:-1, 0] / dt, over_steps(w)))
    return lag_between(pairs, dt)


def own_lag(model: Model, relation: Integral, trials: Sequence[Trial]) -> float:
    """How late a model itself has a velocity behind its position's rate [s], from logged samples.

    A simulator's steps move a position by the velocity before or after them: half of such a step,
    which no sensor makes.
    """
    dt, (i, j, c) = trials[0].dt, (relation.i, relation.j, relation.c)
    x = np.concatenate([trial.states[:-1] for trial in trials])
    u = np.concatenate([trial.inputs for trial in trials])
    known = np.isfinite(x[:, [i, j]]).all(axis=1) & np.isfinite(u).all(axis=1)
    at = np.flatnonzero(known)[:: max(1, int(known.sum()) // OWN)]
    if not len(at):
        return 0.0
    before = np.nan_to_num(x[at], nan=0.0)  # what no sensor shows
    after = model.system.step(before, u[at], model.values, dt)
    changed = c * (after[:, j] - before[:, j])
    moved = model.difference(after, before)[:, i] / dt - c * (after[:, j] + before[:, j]) / 2
    size = float(changed @ changed)
    late = float(moved @ changed) / size * dt if size > 0 else 0.0
    return late if np.isfinite(late) and abs(late) < dt else 0.0


def differenced(model: Model, relation: Integral, trials: Sequence[Trial]) -> bool:
    """Whether the velocity was computed from its position's samples: its change over a step.

    Not where the model itself moves the position by just that velocity.
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
    """The mean of w (T,) over each step but the first and the last (T - 3,), by cubics."""
    return (13 * (w[1:-2] + w[2:-1]) - w[:-3] - w[3:]) / 24


def pieces(trials: Sequence[Trial], columns: Sequence[int]) -> Iterator[Array]:
    """Stretches (T, columns) of the states without gaps."""
    for trial in trials:
        some = trial.states[:, list(columns)]
        good = np.isfinite(some).all(axis=1)
        yield from (some[a:b] for a, b in stretches(np.asarray(good)) if b - a > 4)


@dataclass(frozen=True)
class Turned:
    """The rates of states i and j turn with the heading k; their size is that of `speed`."""

    i: int
    j: int
    k: int
    speed: tuple[int, ...]


def turned(model: Model) -> Turned | None:
    """The plane in which a model moves; None where it has none."""
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
    """The course that was travelled against the model's, from logged states.

    Args:
        agrees: 0 to 1, how well they point the same way but for a constant angle.
        offset: that angle [rad].
        mirrored: how well they agree with the heading's sign changed.
        degrees: how well they agree with the heading taken for degrees.
        speed: how the model's speed stands to the travelled one.
    """

    agrees: float
    offset: float
    mirrored: float
    degrees: float
    speed: Lag | None


def course(model: Model, relation: Turned, trials: Sequence[Trial]) -> Course | None:
    """How the logged positions move, and how the logged heading and speed say they do."""
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
        """The model's velocity at the middle of each step, the heading times a factor."""
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
    """The plane in which a model moves, and the course there; None without sensors for it."""
    relation = turned(model)
    if relation is None or not {relation.i, relation.j, relation.k} <= set(shown):
        return None
    found = course(model, relation, trials)
    return None if found is None else (relation, found)


def judge_speed(model: Model, relation: Turned, lag: Lag | None, dt: float) -> Iterator[Finding]:
    """A late or wrong speed: slipping wheels and drifts do it too, so physics has to judge.

    Args:
        model: whose plane it is.
        relation: of a body that also moves sideways nothing is said: its noises don't add to zero.
        lag: of the speed behind the way, see `Course.speed`.
        dt: [s].
    """
    if lag is None or lag.coherence < SAME_WAY or lag.sign < 0 or len(relation.speed) != 1:
        return
    where = "+".join(model.state_names[i] for i in (relation.i, relation.j))
    d, name = float(abs(lag.delay)), model.state_names[relation.speed[0]]
    if d > max(SURE * lag.std, 0.5 * dt):
        text = f"{d:.3g} s {'later' if lag.delay > 0 else 'earlier'} than {where} move"
        yield Finding(name, text, "delay", float(lag.delay), lag.std)
    if lag.off(OFF):
        text = f"shows {100 * lag.scale:.3g} % of the speed of {where}: a sensor, or slip"
        yield Finding(name, text, "scale", scale=lag.scale)
