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
    """The difference between a row's prediction and its own sensor.

    Attributes:
        share: rms of the difference, relative to how far the state (or others of its unit) moves.
        varying: the same without a constant difference.
        rate: rms of the difference per time [unit/s].
        ratio: measured displacement over the predicted one, by regression beside a drift.
        power: variance of the predicted displacement, which weighs the ratio.
    """

    share: float
    varying: float
    rate: float
    ratio: float
    power: float


def kinematic_rows(model: Model, shown: Sequence[int]) -> list[Row]:
    """Return the kinematic rows of a model whose states all have sensors.

    Args:
        model: any; a simulator that can't take a short step has no such rows.
        shown: indices of the states with a sensor.
    """
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

    Args:
        model: with these rows.
        trial: with this model's states.
        rows: of the model; those hidden by noise are missing from the result.
    """
    known = [row for row in rows if np.isfinite(trial.states[:, [*row.states]]).any(axis=0).all()]
    found: dict[Row, Gap] = {}
    # rows of states that are logged at the same samples are compared together
    for some in (known,) if _together(trial, known) else ((row,) for row in known):
        each = per_step(model, trial, some)
        moved, said = ([np.cumsum(z[k], axis=0) for z in each] for k in (0, 1))
        longest = max((len(x) for x in moved), default=0)
        steps = max(1, min(round(STRETCH / trial.dt), (longest - 1) // STEPS_TO_JUDGE))
        while usable := [k for k, x in enumerate(moved) if len(x) > STEPS_TO_JUDGE * steps]:
            far, told = (
                np.concatenate([z[k][steps:] - z[k][:-steps] for k in usable])
                for z in (moved, said)
            )
            noise = np.concatenate([np.diff(moved[k], axis=0, n=2) for k in usable])
            for row, gap in _over(
                model, some, far, told, _size(noise) / np.sqrt(3), steps * trial.dt
            ):
                if row not in found or gap.share < found[row].share:
                    found[row] = gap
            steps *= 2
    return found


def _together(trial: Trial, rows: Sequence[Row]) -> bool:
    known = np.isfinite(trial.states[:, sorted({i for row in rows for i in row.states})])
    return bool((known.all(axis=1) == known.any(axis=1)).all())


def _over(
    model: Model, rows: Sequence[Row], far: Array, told: Array, noise: Array, length: float
) -> Iterator[tuple[Row, Gap]]:
    """Yield the gap of each row over stretches of one length [s].

    It is relative to the motion of all states of the same unit: a row's own may hardly move. What
    white noise of its sensor explains is no gap.
    """
    units, told = list(model.states.values()), np.array(told)
    for row in rows:
        if row.low < row.high:  # of a size that is fitted
            times = (far[:, row.i] @ told[:, row.i]) / max(
                float((told[:, row.i] ** 2).sum()), 1e-300
            )
            told[:, row.i] *= np.clip(times, row.low, row.high)
    moved, said, power = _size(far), _size(told), told.var(axis=0)
    off, varying = (
        np.sqrt(np.maximum(square - noise**2, 0.0))
        for square in (_size(far - told) ** 2, np.var(far - told, axis=0))
    )
    both = (far * (told - told.mean(axis=0))).mean(axis=0)
    for row in rows:
        i, same = row.i, [one.i for one in rows if units[one.i] == units[row.i]]
        size = float(max(moved[i], said[i], np.sqrt((said[same] ** 2).mean())))
        if size > 0 and noise[i] < HALF * size:
            ratio = float(both[i] / max(power[i], 1e-300))
            yield row, Gap(off[i] / size, varying[i] / size, off[i] / length, ratio, power[i])


def per_step(model: Model, trial: Trial, rows: Sequence[Row]) -> list[tuple[Array, Array]]:
    """Return for each piece the displacements per step: measured, and predicted by the rows.

    Args:
        model: with these rows.
        trial: with this model's states; a piece has no gaps in the states that the rows relate.
        rows: of the model.

    Returns:
        Two arrays (T - 1, n) per piece; only the columns of the rows' states are meaningful.
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


def _size(x: Array) -> Array:
    return np.asarray(np.sqrt((x**2).mean(axis=0)))


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
