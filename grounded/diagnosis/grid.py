"""The grid of scanned values: its points, which of them are tried, what lies below the first."""

from __future__ import annotations

import itertools

import numpy as np

from grounded.effects import Effect

NEAR = 3.0  # nats within which another grid point is tried too
NEARLY = 0.7  # or part of the best one's gain
MOST_OTHERS = 2


def grid_points(effect: Effect) -> list[dict[str, float]]:
    """All combinations of scanned values; one empty point for an effect that is all linear."""
    scanned = [q for q in effect.free if q.grid]
    grids = [q.grid for q in scanned]
    names = [q.name for q in scanned]
    return [dict(zip(names, point, strict=True)) for point in itertools.product(*grids)]


def elsewhere(
    effect: Effect, looks: list[tuple[float, dict[str, float]]]
) -> tuple[dict[str, float], ...]:
    """Grid points that gain nearly as much and are neighbours of none that was taken."""
    best = looks[0][0]
    enough = min(best - NEAR, NEARLY * best)
    taken = [looks[0][1]]
    for gain, values in looks[1:]:
        if gain < enough or len(taken) > MOST_OTHERS:
            break
        if all(apart(effect, values, other) for other in taken):
            taken.append(values)
    return tuple(taken[1:])


def apart(effect: Effect, one: dict[str, float], other: dict[str, float]) -> bool:
    """Whether two grid points are no neighbours."""
    for q in effect.free:
        if q.grid:
            grid = np.sort(np.array(q.grid))
            i, j = (int(np.argmin(np.abs(grid - v[q.name]))) for v in (one, other))
            if abs(i - j) > 1:
                return True
    return False


def faint(effect: Effect, grid: dict[str, float], score: float, gram: float) -> float:
    """How much of the smallest grid value: below it an effect that is absent at zero is linear."""
    (scanned,) = (q for q in effect.free if q.grid)
    if scanned.start != 0 or grid[scanned.name] > min(scanned.grid) or gram <= 0:
        return 1.0
    return float(np.clip(-score / gram, 0.05, 1.0))
