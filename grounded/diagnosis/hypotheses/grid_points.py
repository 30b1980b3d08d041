"""Choose among the grid points of an effect's scanned quantities, by the gain at each of them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from grounded.effects import Effect
from grounded.frozen import Array

MOST_OTHERS = 2  # places beside the best from which a fit starts
FAINT = 0.05  # least way from a weaker grid point, so that a fit has a slope to start from


def grid_points(effect: Effect) -> list[dict[str, float]]:
    """Return all combinations of scanned values; one empty point if all quantities are linear."""
    grids = {q.name: q.grid for q in effect.free if q.grid}
    return [dict(zip(grids, point, strict=True)) for point in itertools.product(*grids.values())]


def inside(effect: Effect, names: Sequence[str], value: Array) -> Array:
    """Return values of linear quantities, clipped to their bounds."""
    bounds = {q.name: (q.low, q.high) for q in effect.free}
    return np.array([np.clip(v, *bounds[name]) for name, v in zip(names, value, strict=True)])


def elsewhere(
    effect: Effect, looks: list[tuple[float, dict[str, float]]]
) -> tuple[dict[str, float], ...]:
    """Return the best of the other local maxima of the gain over the grid, given best first.

    A change is linear only near the fit that is scanned, so the best grid point need not lead to
    the best fit. A local maximum has no grid point beside it that gains more.
    """
    grids = {q.name: np.sort(np.array(q.grid)) for q in effect.free if q.grid}
    at = np.array(
        [[np.argmin(np.abs(grid - v[n])) for n, grid in grids.items()] for _, v in looks], int
    )
    found = [
        values
        for k, (gain, values) in enumerate(looks)
        if gain > 0 and (np.abs(at[:k] - at[k]).max(axis=1, initial=0) > 1).all()
    ]
    return tuple(found[1 : 1 + MOST_OTHERS])


def between(
    effect: Effect, changes: Sequence[tuple[dict[str, float], float, float]]
) -> list[tuple[float, dict[str, float]]]:
    """Return the best gain and value between each grid point and the next weaker one.

    A change is taken as linear between two grid points, and between the weakest and none. So a
    threshold is found that a few samples exceed, where one grid point does nothing and the next too
    much.

    Args:
        effect: an effect with one scanned quantity.
        changes: each grid point, its score (the gain's slope, negated) and its squared size.
    """
    found = []
    for grid, score, gram in changes:
        ((name, value),) = grid.items()
        (none,) = (q.start for q in effect.free if q.name == name)
        away = {other[name]: size for other, _, size in changes}
        weaker = [c for c in away if 0 <= (c - none) / (value - none) < 1]
        below = min(weaker, key=lambda c: abs(c - value), default=none)
        size = away.get(below, 0.0)
        least = float(np.sqrt(size / gram)) if 0 < size < gram else 0.0
        part = float(np.clip(-score / gram, least, 1.0)) if gram > 0 else 1.0
        way = max((part - least) / (1 - least), FAINT)
        gain = -part * score - 0.5 * part**2 * gram
        found.append((gain, {name: below + way * (value - below)}))
    return found
