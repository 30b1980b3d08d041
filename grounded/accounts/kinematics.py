"""What positions, velocities and headings imply of each other, whatever the physics.

The rate of some states consists of logged velocities, perhaps rotated by logged angles: q' = w,
x' = u cos psi - v sin psi. No input enters such a row; an uncertain parameter only as a constant (a
current), or as its size (the radius of a wheel), which is fitted within the parameter's bounds. The
displacement that a row predicts over stretches of a log is compared with that of its own sensor:
the unexplained share is about 1 where a column is dead, in another unit, of the other sign or in
another's place, and small in an honest log, however wrong the model.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import NamedTuple

import numpy as np

from grounded import places
from grounded.accounts.levels import FINE, HALF, STEPS_TO_JUDGE
from grounded.frozen import Array, wrapped
from grounded.model import Model
from grounded.trial import Trial, stretches

INSTANT_S = 1e-6  # [s] time step from which rates are computed
STRETCH = 0.3  # [s] shortest stretch


@dataclass(frozen=True)
class Row:
    """The rate of state i depends on the states `by` alone; with `c` set, c times a single one.

    Uncertain parameters may make it `low` to `high` times as large.
    """

    i: int
    by: tuple[int, ...]
    c: float = 0.0
    low: float = 1.0
    high: float = 1.0

    @property
    def states(self) -> frozenset[int]:
        """All states that the row relates."""
        return frozenset((self.i, *self.by))


class Gap(NamedTuple):
    """The difference between a row's prediction and its own sensor."""

    share: float  # rms, relative to how far the state (or others of its unit) moves
    varying: float  # the same without a constant difference
    rate: float  # rms of the difference per time [unit/s]
    ratio: float  # measured displacement over the predicted one, by regression beside a drift
    power: float  # variance of the predicted displacement, which weighs the ratio


def kinematic_rows(model: Model, shown: Sequence[int]) -> list[Row]:
    """Return a model's rows of measured states; none of a simulator without short steps."""
    model, found = places.direct(model), list[Row]()
    dt = places.probe(model, INSTANT_S)
    if dt > INSTANT_S:
        return found
    # rates that no input changes, and a parameter in size only; they double with all velocities
    x, u = places.within_limits(model, 8)
    f_x, f_u = model.system.linearise(x, u, model.values, dt)
    slopes = (f_x - np.eye(model.n)) / dt
    fast = np.array([unit.endswith("/s") for unit in model.states.values()])
    rates, doubled = (_rates(model, z) for z in (x, np.where(fast, 2 * x, x)))
    size = FINE * np.abs(rates).max(axis=0)
    fixed = np.abs(f_u).max(axis=(0, 2)) / dt < size
    low, high = np.ones((2, model.n))
    for k, one in enumerate(model.params.values()):
        ends = (one.low, one.high) if one.uncertain else ()
        for end, other in zip(ends, (0.9, 1.1), strict=False):
            values = np.array(model.values)
            values[k] = other * values[k] + 0.01 if end is None else end
            moved = (model.system.step(x, u, values, dt) - x) / dt
            times = (moved * rates).sum(axis=0) / np.maximum((rates**2).sum(axis=0), 1e-300)
            plain = np.ptp(moved - rates, axis=0) < size
            times = np.where(plain, 1.0, times)
            fixed &= plain | ((np.abs(moved - times * rates).max(axis=0) < size) & (times > 0))
            low, high = low * np.minimum(times, 1), high * np.maximum(times, 1)
    fixed &= ~fast & (np.ptp(doubled - 2 * rates, axis=0) < size)
    for i in (i for i in shown if i < model.n):
        slope = np.abs(slopes[:, i]).max(axis=0)
        by = tuple(int(j) for j in np.flatnonzero(slope > FINE * slope.max()))
        if fixed[i] and i not in by and {*by} <= {*shown}:
            found.append(Row(i, by, 0.0, float(low[i]), float(high[i])))
    return found


def gaps(model: Model, trial: Trial, rows: Sequence[Row]) -> dict[Row, Gap]:
    """Return the gap of each row, over the stretch length at which it agrees best.

    What white noise of its sensor explains is no gap; a row that it hides has none.
    """
    known = [row for row in rows if np.isfinite(trial.states[:, [*row.states]]).any(axis=0).all()]
    units, found = list(model.states.values()), dict[Row, Gap]()
    ways = {
        row: [
            np.cumsum([z[:, row.i] for z in both], axis=1) for both in per_step(model, trial, [row])
        ]
        for row in known
    }
    longest = max((way.shape[1] for every in ways.values() for way in every), default=0)
    steps = max(1, min(round(STRETCH / trial.dt), (longest - 1) // STEPS_TO_JUDGE))
    while over := {row: one for row, every in ways.items() if (one := _over(row, every, steps))}:
        for row, (far, told, noise) in over.items():
            # relative to all states of the same unit: a row's own may hardly move
            same = [_rms(one[1]) for other, one in over.items() if units[other.i] == units[row.i]]
            size = max(_rms(far), _rms(told), _rms(np.array(same)))
            if size > 0 and noise < HALF * size:
                off, power = far - told, float(told.var())
                share, varying = (
                    max(x - noise**2, 0.0) ** 0.5 for x in (_rms(off) ** 2, off.var())
                )
                ratio = float((far * (told - told.mean())).mean() / max(power, 1e-300))
                rate = share / (steps * trial.dt)
                gap = Gap(share / size, varying / size, rate, ratio, power)
                if row not in found or gap.share < found[row].share:
                    found[row] = gap
        steps *= 2
    return found


def _over(row: Row, ways: Sequence[Array], steps: int) -> tuple[Array, Array, float] | None:
    """Return displacements over so many steps, measured and by a row, and the former's noise.

    Ways are both from the begin of each piece on, (2, T - 1). None if no piece holds enough steps.
    """
    usable = [way for way in ways if way.shape[1] > STEPS_TO_JUDGE * steps]
    if not usable:
        return None
    far, told = np.concatenate([way[:, steps:] - way[:, :-steps] for way in usable], axis=1)
    noise = np.concatenate([np.diff(way[0], n=2) for way in usable])
    if row.low < row.high:
        told *= np.clip(float(far @ told) / max(float(told @ told), 1e-300), row.low, row.high)
    return far, told, _rms(noise) / np.sqrt(3)


def per_step(model: Model, trial: Trial, rows: Sequence[Row]) -> list[tuple[Array, Array]]:
    """Return for each piece the displacements per step, measured and by the rows, (T - 1, n) each.

    A piece has no gaps in the states that the rows relate; only their columns are meaningful.
    """
    some, found = sorted({i for row in rows for i in row.states}), []
    for piece in pieces([trial], some) if rows else ():
        x = np.zeros((len(piece), model.n))
        x[:, some] = piece
        moved = wrapped(np.diff(x, axis=0), model.angle_mask)
        found.append((moved, _told(model, rows, x) * trial.dt))
    return found


def _told(model: Model, rows: Sequence[Row], x: Array) -> Array:
    """Return the rates over each step by the rows (T - 1, n); 0 for other states."""
    found = np.zeros((len(x) - 1, model.n))
    for row in rows:
        alone = np.full_like(x, 0.5)  # other states must not act, however large
        alone[:, row.by] = x[:, row.by]
        rate = row.c * x[:, row.by[0]] if row.c else _rates(model, alone)[:, row.i]
        found[:, row.i] = 0.5 * (rate[1:] + rate[:-1])
    return found


def _rates(model: Model, x: Array) -> Array:
    """Return the modelled rates (T, n) at states (T, n), for a fixed input."""
    u = np.full((len(x), model.m), 0.5)
    return np.asarray((model.system.step(x, u, model.values, INSTANT_S) - x) / INSTANT_S)


def _rms(x: Array) -> float:
    return float(np.sqrt((x**2).mean()))


def pieces(trials: Sequence[Trial], columns: Sequence[int]) -> Iterator[Array]:
    """Yield the stretches (T, columns) of the states that have no gaps."""
    for trial in trials:
        some = trial.states[:, list(columns)]
        good = np.isfinite(some).all(axis=1)
        yield from (some[a:b] for a, b in stretches(np.asarray(good)) if b - a > 4)


class Turned(NamedTuple):
    """The rates of states i and j rotate with heading k."""

    i: int
    j: int
    k: int


def turned(model: Model) -> Turned | None:
    """Return the plane in which a model moves; None if it has none."""
    (x, u), n = places.samples(model, 8), model.n
    short = places.probe(model, INSTANT_S)
    f_x, f_u = model.system.linearise(x, u, model.values, short)
    rates = (model.system.step(x, u, model.values, short) - x) / short
    slopes = (f_x - np.eye(n)) / short
    moves = np.abs(rates).max(axis=0)
    free = np.flatnonzero((np.abs(f_u).max(axis=(0, 2)) < 1e-9) & (moves > 0)).tolist()
    for i, j, k in ((i, j, k) for i, j in permutations(free, 2) for k in range(n)):
        off = np.abs([slopes[:, i, k] + rates[:, j], slopes[:, j, k] - rates[:, i]]).max(axis=1)
        if k not in (i, j) and (off < 1e-3 * np.maximum(moves[[j, i]], 1e-9)).all():
            return Turned(i, j, k)
    return None


def away(model: Model, trials: Sequence[Trial], rows: Sequence[Row], plane: Turned) -> float:
    """Return the constant angle [rad] by which a heading must grow for positions to follow it."""
    both, total = [row for row in rows if row.i in (plane.i, plane.j)], 0j
    for trial in trials:
        for moved, said in per_step(model, trial, both):
            m, s = (one[:, plane.i] + 1j * one[:, plane.j] for one in (moved, said))
            total += complex((m * s.conj()).sum())
    return float(np.angle(total))
