"""Kinematic rows of a model: states whose rate follows from other sensors, whatever the physics.

The rate of such a state consists of logged velocities, possibly rotated by logged angles:
x' = u cos psi - v sin psi, psi' = r. No input or uncertain parameter enters it, except as a
constant (a current). The displacement that a row predicts over stretches of a log is compared with
that of its own sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded import places
from grounded.frozen import Array, wrapped
from grounded.instruments.kinematics.relations import SHORT, pieces
from grounded.model import Model
from grounded.places import integrals
from grounded.trial import Trial

STRETCH = 0.3  # [s] shortest stretch
LEAST = 8  # stretches that a trial must hold
NOISE = 0.3  # noise relative to the displacement over a stretch, above which a row is ignored
SMALL = 1e-4  # of a rate, or of its largest derivative: treated as zero


@dataclass(frozen=True)
class Row:
    """The rate of state i depends on the states `by` alone."""

    i: int
    by: tuple[int, ...]

    @property
    def states(self) -> frozenset[int]:
        """All states that the row relates."""
        return frozenset((self.i, *self.by))


@dataclass(frozen=True)
class Gap:
    """The difference between a row's prediction and its own sensor.

    Args:
        share: rms of the difference, relative to how far the state (or others of its unit) moves.
        varying: the same without a constant difference.
        rate: rms of the difference per time [unit/s].
    """

    share: float
    varying: float
    rate: float


def kinematic_rows(model: Model, shown: Sequence[int]) -> list[Row]:
    """Return the kinematic rows of a model whose states all have sensors.

    Args:
        model: any; a simulator that can't take a short step has no such rows.
        shown: indices of the states with a sensor.
    """
    model = places.direct(model)
    dt = places.probe(model, SHORT)
    if dt > SHORT:
        return []
    x, u = places.within_limits(model, 8)
    f_x, f_u = model.system.linearise(x, u, model.values, dt)
    slopes = (f_x - np.eye(model.n)) / dt
    fast = np.array([unit.endswith("/s") for unit in model.states.values()])
    rates, doubled = (_rates(model, z) for z in (x, np.where(fast, 2 * x, x)))
    size = SMALL * np.abs(rates).max(axis=0)
    fixed = np.abs(f_u).max(axis=(0, 2)) / dt < size
    for values in _shifted(model):
        moved = (model.system.step(x, u, values, dt) - x) / dt
        fixed &= np.ptp(moved - rates, axis=0) < size
    fixed &= ~fast & (np.ptp(doubled - 2 * rates, axis=0) < size)
    found = []
    for i in shown:
        slope = np.abs(slopes[:, i]).max(axis=0)
        by = tuple(int(j) for j in np.flatnonzero(slope > SMALL * slope.max()))
        if fixed[i] and i not in by and set(by) <= set(shown):
            found.append(Row(i, by))
    return found


def unheld(model: Model, trials: Sequence[Trial]) -> tuple[str, ...]:
    """Return the logged states that can't be checked against any other sensor.

    Args:
        model: whose kinematics relate sensors.
        trials: of this model's states.
    """
    shown = [i for i in range(model.n) if any(np.isfinite(t.states[:, i]).any() for t in trials)]
    held = {i for row in kinematic_rows(model, shown) for i in row.states}
    held |= {i for one in integrals(model) if {one.i, one.j} <= {*shown} for i in (one.i, one.j)}
    return tuple(model.state_names[i] for i in shown if i not in held)


def tied(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of three or more states, and those of two that share a state with them.

    A position and its velocity alone don't show which of the two is wrong.
    """
    several = frozenset[int]().union(*(row.states for row in rows if len(row.by) > 1))
    return [row for row in rows if row.states & several]


def gaps(model: Model, trial: Trial, rows: Sequence[Row]) -> dict[Row, Gap]:
    """Return the gap of each row, over the stretch length at which it agrees best.

    Args:
        model: with these rows.
        trial: with this model's states.
        rows: of the model; those hidden by noise are missing from the result.
    """
    known = [row for row in rows if _known(trial, row)]
    each = per_step(model, trial, known)
    moved, said = ([np.cumsum(z[k], axis=0) for z in each] for k in (0, 1))
    found: dict[Row, Gap] = {}
    longest = max((len(x) for x in moved), default=0)
    steps = max(1, min(round(STRETCH / trial.dt), longest // LEAST))
    while usable := [k for k, x in enumerate(moved) if len(x) > LEAST * steps]:
        far, told = (
            np.concatenate([z[k][steps:] - z[k][:-steps] for k in usable]) for z in (moved, said)
        )
        noise = np.concatenate([np.diff(moved[k], axis=0, n=2) for k in usable])
        for row, gap in _over(model, known, far, told, _size(noise) / 3, steps * trial.dt):
            if row not in found or gap.share < found[row].share:
                found[row] = gap
        steps *= 2
    return found


def _over(
    model: Model, rows: Sequence[Row], far: Array, told: Array, noise: Array, length: float
) -> list[tuple[Row, Gap]]:
    """Return the gap of each row over stretches of one length [s].

    It is relative to the motion of all states of the same unit: a row's own may hardly move.
    """
    units = list(model.states.values())
    moved, said, off = _size(far), _size(told), _size(far - told)
    varying = np.std(far - told, axis=0)
    found = []
    for row in rows:
        same = [one.i for one in rows if units[one.i] == units[row.i]]
        size = float(max(moved[row.i], said[row.i], np.sqrt((said[same] ** 2).mean())))
        if size > 0 and noise[row.i] < NOISE * size:
            share, rest, rate = (
                float(x[row.i]) / by for x, by in ((off, size), (varying, size), (off, length))
            )
            found.append((row, Gap(share, rest, rate)))
    return found


def per_step(model: Model, trial: Trial, rows: Sequence[Row]) -> list[tuple[Array, Array]]:
    """Return for each piece the displacements per step: measured, and predicted by the rows.

    Args:
        model: with these rows.
        trial: with this model's states; a piece has no gaps in the states that the rows relate.
        rows: of the model.

    Returns:
        Two arrays (T - 1, n) per piece; only the columns of the rows' states are meaningful.
    """
    some, found = sorted(frozenset[int]().union(*(row.states for row in rows))), []
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
        rate = _rates(model, alone)[:, row.i]
        found[:, row.i] = 0.5 * (rate[1:] + rate[:-1])
    return found


def _rates(model: Model, x: Array) -> Array:
    """Return the modelled rates (T, n) at states (T, n), for a fixed input."""
    u = np.full((len(x), model.m), 0.5)
    return np.asarray((model.system.step(x, u, model.values, SHORT) - x) / SHORT)


def _shifted(model: Model) -> list[Array]:
    """Return the parameter values with one uncertain parameter changed, for each of these."""
    found = []
    for k, one in enumerate(model.params.values()):
        if one.low is not None or one.high is not None or one.std is not None:
            values = np.array(model.values)
            values[k] = 1.1 * values[k] + 0.01
            found.append(values)
    return found


def _known(trial: Trial, row: Row) -> bool:
    return bool(np.isfinite(trial.states[:, sorted(row.states)]).any(axis=0).all())


def _size(x: Array) -> Array:
    return np.asarray(np.sqrt((x**2).mean(axis=0)))
