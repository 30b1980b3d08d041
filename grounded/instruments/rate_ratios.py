"""The rate of each position over the velocity that belongs to it, per trial.

A ratio far from 1 shows a wrong unit or wrong time stamps; the sizes in sound trials show which of
the two sensors is off.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grounded.frozen import Array
from grounded.instruments.kinematics import over_steps, pieces
from grounded.model import Model
from grounded.places import Integral, integrals
from grounded.trial import Trial

TOGETHER = 0.95  # cosine between displacements by position and by velocity, in the best window
TURNS = (2 * np.pi, 360.0)  # jumps of a wrapped angle
LEAST = 8  # windows that a trial must hold

Ratios = Sequence[tuple[Integral, float]]  # of a trial's positions, see `ratios_of`


def ratios_of(model: Model, trials: Sequence[Trial], shown: Sequence[int]) -> list[Ratios]:
    """Return for each trial the rate of each position over its velocity.

    The ratio is 1 where the two do not correlate, and no ratio can be given.
    """
    relations = [one for one in integrals(model) if {one.i, one.j} <= set(shown)]
    return [_ratios(relations, trial) for trial in trials]


def _ratios(relations: Sequence[Integral], trial: Trial) -> Ratios:
    """Return the ratios over the window with the best agreement; longer ones suppress noise."""
    found = []
    for relation in relations:
        some = [
            (_unturned(x[:, 0])[1:-1], np.cumsum([0.0, *over_steps(relation.c * x[:, 1])]))
            for x in pieces([trial], (relation.i, relation.j))
        ]
        best, ratio, steps = TOGETHER, 1.0, 1
        while usable := [pair for pair in some if len(pair[0]) > LEAST * steps]:
            parts = [[z[steps:] - z[:-steps] for z in pair] for pair in usable]
            moved, said = (np.concatenate(z) for z in zip(*parts, strict=True))
            same = abs(moved @ said) / max(size_of(moved) * size_of(said) * len(said), 1e-300)
            if same > best:
                best, ratio = same, size_of(moved) / (size_of(said) * trial.dt)
            steps *= 2
        if some:
            found.append((relation, ratio))
    return found


def _unturned(q: Array) -> Array:
    """Remove the jumps of a wrapped angle."""
    steps = np.diff(q)
    for turn in TURNS:
        jumps = np.abs(np.abs(steps) - turn) < 0.1 * turn
        if np.median(np.abs(steps)) < 0.05 * turn:
            steps -= np.where(jumps, np.sign(steps) * turn, 0.0)
    return np.concatenate([[q[0]], q[0] + np.cumsum(steps)])


def spread(trial: Trial, some: Sequence[int]) -> Array:
    """Return the standard deviations of some states (len(some),), in their units."""
    return np.asarray(np.nanstd(trial.states[:, some], axis=0) + 1e-300)


def size_of(x: Array) -> float:
    """Return the root mean square of x, of any shape, ignoring NaN; 0 if it is empty."""
    return float(np.sqrt(np.nanmean(x**2))) if x.size else 0.0
