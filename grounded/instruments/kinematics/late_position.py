"""Detect positions that lag behind velocities and heading, as from a GPS receiver or a camera.

The velocity S of a position that is late by d is off by -d S'. Other causes also act along the path
or across it: a slipping wheel by k S' along it, an unmodelled side slip by k S' across it, a
tracked point l ahead of the modelled one by l omega across it, a drift by a constant. The delay is
therefore estimated together with these. If the sideways velocity is not measured, the delay must
show both along and across the path. If only one position is late, about half its delay shows in
both directions as well, so each position must have the same delay on its own; otherwise the
identification of the physics decides which one is late.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.frozen import Array
from grounded.instruments.kinematics.relations import turned
from grounded.instruments.kinematics.rows import Row, per_step
from grounded.instruments.lag import BLOCKS, SURE, Lag, at_samples, lag_between
from grounded.model import Model
from grounded.trial import Trial

LIKE = 0.9  # coherence above which positions follow the other sensors
LEAST_STEPS = 0.5  # of a time step: smaller delays may come from the time stamps
AGREE, CLOSE = 2.5, 0.15  # standard deviations, or share of the delay: delays are equal
UNSURE = 0.25  # of the delay: with a larger standard deviation nothing is concluded
SMOOTH_S = 0.3  # [s] half the smoothing window, at least three samples

Way = tuple[Array, Array]  # displacement in each step: measured, and by the other sensors (T, 2)


@dataclass(frozen=True)
class Late:
    """Two positions (indices of states) that are late by the same delay."""

    states: tuple[int, int]
    lag: Lag


def late_positions(model: Model, trials: Sequence[Trial], rows: Sequence[Row]) -> Late | None:
    """Return both positions of a plane if they share a significant delay, else None.

    Args:
        model: however crude.
        trials: of one time step, already corrected for other faults.
        rows: the model's kinematic rows, see `rows.kinematic_rows`.
    """
    plane = turned(model)
    both = [row for row in rows if plane and row.i in (plane.i, plane.j)]
    if plane is None or len(both) != 2:
        return None
    dt, columns = trials[0].dt, [row.i for row in both]
    ways = [(z[:, columns], s[:, columns]) for t in trials for z, s in per_step(model, t, both)]
    lag = lag_between([(said[:, k], moved[:, k]) for k in (0, 1) for moved, said in ways], dt)
    if lag is None or lag.sign < 0 or lag.coherence < LIKE:
        return None
    if lag.delay < max(SURE * lag.std, LEAST_STEPS * dt) or _apart(ways, lag, dt):
        return None
    apart = len(_velocities(model, both)) < 2
    if any(std > UNSURE * late for late, std in _left(ways, 0.0, dt, apart=apart)):
        return None
    for left, std in _left(ways, lag.delay / dt, dt, apart=apart):
        if std > UNSURE * lag.delay or abs(left) > max(AGREE * std, CLOSE * lag.delay):
            return None
    return Late((both[0].i, both[1].i), lag)


def _velocities(model: Model, rows: Sequence[Row]) -> set[int]:
    """Return the velocities that two positions follow from, without the angles between them.

    A steering angle changes how far a car's rear wheels travel, but not sideways.
    """
    units = list(model.states.values())
    return {j for row in rows for j in row.by if units[j].endswith("/s")}


def _apart(ways: Sequence[Way], both: Lag, dt: float) -> bool:
    """Check whether the two positions, each on its own, have significantly different delays."""
    each = [lag_between([(said[:, k], moved[:, k]) for moved, said in ways], dt) for k in (0, 1)]
    one, other = each
    if one is None or other is None:
        return False
    sure = AGREE * float(np.hypot(one.std, other.std))
    return abs(one.delay - other.delay) > max(sure, CLOSE * both.delay)


def _left(
    ways: Sequence[Way], steps: float, dt: float, *, apart: bool
) -> list[tuple[float, float]]:
    """Return the delay [s] that remains after shifting positions, with its standard deviation.

    Args:
        ways: displacements of each piece.
        steps: by which the positions are shifted earlier.
        dt: time step [s].
        apart: estimate the delay along the path and across it separately.
    """
    h = max(3, round(SMOOTH_S / dt))
    window = np.hanning(2 * h + 3)[1:-1]
    window /= window.sum()
    rests, designs = [np.empty(0)], [np.empty((0, 6 if apart else 5))]
    for moved, said in ways:
        at = np.arange(len(moved)) + steps
        early = np.stack([at_samples(moved[:, k], at) for k in (0, 1)], axis=1)
        known = np.isfinite(early).all(axis=1)
        if known.sum() < 3 * len(window):
            continue
        z, s = (
            np.stack([np.convolve(one[known][:, k], window, "valid") for k in (0, 1)], axis=1) / dt
            for one in (early, said)
        )
        slope, size = np.gradient(s, dt, axis=0), np.maximum(np.hypot(*s.T), 1e-9)[:, None]
        ahead = s / size
        side = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
        along = (slope * ahead).sum(axis=1, keepdims=True) * ahead
        turn = (slope * side).sum(axis=1, keepdims=True) / size
        late = [along, slope - along] if apart else [slope]
        others = [turn * side, -turn * ahead, ahead, side]
        design = np.stack([*(-one for one in late), *others], axis=2)
        for k in (0, 1):
            rests.append((z - s)[:, k] - (z - s)[:, k].mean())
            designs.append(design[:, k] - design[:, k].mean(axis=0))
    rest, design = np.concatenate(rests), np.concatenate(designs)
    if len(rest) < BLOCKS or np.linalg.matrix_rank(design) < design.shape[1]:
        return [(0.0, np.inf)]
    spread = np.linalg.inv(design.T @ design)
    found = spread @ design.T @ rest
    forces = design * (rest - design @ found)[:, None]
    parts = np.stack([part.sum(axis=0) for part in np.array_split(forces, 2 * BLOCKS)])
    stds = np.sqrt(np.diag(spread @ parts.T @ parts @ spread))
    return [(float(found[k]), float(stds[k])) for k in range(1 + apart)]
