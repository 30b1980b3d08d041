"""Detect two exchanged columns of a log by comparing positions with their velocities.

With the log as it is, a position does not move as its velocity implies; with two columns exchanged
it does, in size and direction. No unmodelled effect causes that. Joints may move so much alike that
each roughly follows the other's velocity; then an exchange must improve both. Where a load swings,
its velocity changes as its angle, with the opposite sign and another size: in either order the two
have nearly the same shape, but only in the right one the same size, and the better shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.frozen import Array
from grounded.instruments.kinematics.relations import over_steps, pieces
from grounded.model import Model
from grounded.places import Integral, integrals
from grounded.trial import Trial

BROKEN, WHOLE = 0.8, 0.97  # cosine of displacements by position and velocity: bad, and good
SIZED = 1.25  # factor within which the two sizes agree
CLEARLY, ROUNDING = 4.0, 1e-9  # factor of the best 1 - cosine within which others are as good
LEAST = 8  # windows that a trial must hold
MIRRORED = ", one with the opposite sign,"  # of a position and its velocity, by a scale in [log]


def swapped_columns(
    model: Model,
    trial: Trial,
    shown: Sequence[int] | None = None,
    relations: Sequence[Integral] | None = None,
) -> str:
    """Return the names of two exchanged signals of a trial, such as `x and v`; "" if none are.

    `MIRRORED` follows the names of a position and its velocity of which one is negated as well.

    Args:
        model: however crude; used only for which state is the rate of which.
        trial: with this model's states and inputs.
        shown: indices of the states with a sensor; None: all that are known in the trial.
        relations: `integrals(model)`, if already computed.
    """
    relations = integrals(model) if relations is None else relations
    known = range(model.n) if shown is None else shown
    some = [i for i in known if np.isfinite(trial.states[:, i]).any()]
    exact = [r for r in relations if r.exact and {r.i, r.j} <= set(some)]
    odd = {r: left for r in exact if (left := _mirrored_too(trial, r)) > 1 - WHOLE}
    broken = [r for r in odd if _together(trial, r)[0] < BROKEN]
    names = [*trial.state_names, *trial.input_names]
    columns = [*some, *range(model.n, model.n + model.m)]
    touched = {i for r in broken for i in (r.i, r.j)}
    found = {}
    for pair in combinations(columns, 2):
        both = [odd[r] for r in odd if {r.i, r.j} & set(pair)]
        named = f"{names[pair[0]]} and {names[pair[1]]}"
        if touched & set(pair) or len(both) > 1:
            left = _left(_exchanged(trial, pair), exact)
            if touched & set(pair) or CLEARLY * left < min(both):
                found[named] = left
        if own := [r for r in odd if {r.i, r.j} == set(pair)]:
            back = _exchanged(trial, pair)
            shape = 1 - max(_together(trial, one)[0] for r in own for one in (r, _negated(r)))
            negated = [_negated(r) if r in own else r for r in exact]
            for said, relied in ((named, exact), (f"{named}{MIRRORED}", negated)):
                if CLEARLY * (left := _left(back, relied)) < shape:
                    found[said] = left
    least = CLEARLY * max(min(found.values(), default=1.0), ROUNDING)
    found = {pair: left for pair, left in found.items() if left < min(least, 1 - WHOLE)}
    return " (or ".join(found) + ")" * (len(found) - 1)


def judge_columns(model: Model, trials: Sequence[Trial], shown: Sequence[int]) -> None:
    """Raise an error for trials with two exchanged columns.

    Raises:
        GroundedError: naming the trials and the columns.
    """
    relations = integrals(model)
    found = [(trial, swapped_columns(model, trial, shown, relations)) for trial in trials]
    odd = [(trial.id or f"number {k + 1}", pair) for k, (trial, pair) in enumerate(found) if pair]
    if not odd:
        return
    pair = odd[0][1]
    same = [trial for trial, other in odd if other == pair]
    one = len(same) == 1
    raise GroundedError(
        f"trial{'s' * (not one)} {', '.join(same)}: {exchanged(pair)}. Correct the log, or the "
        f"paths in [log]; then discard {'this trial' if one else 'these trials'} and ingest the "
        "log again",
        then=NextCommand("discard", tuple(same)) if trials[0].id else None,
    )


def exchanged(pair: str) -> str:
    """Return a clause on two exchanged columns.

    Args:
        pair: their names, such as `x and v`.
    """
    return (
        f"the columns of {pair} look exchanged: only with them swapped do positions move as their "
        "velocities imply"
    )


def _together(trial: Trial, relation: Integral) -> tuple[float, float]:
    """Return cosine and size ratio of displacements by position and velocity, at best window."""
    some = [
        (x[1:-2, 0], np.cumsum([0.0, *over_steps(relation.c * x[:, 1])])[:-1] * trial.dt)
        for x in pieces([trial], (relation.i, relation.j))
        if len(x) > LEAST
    ]
    best, steps = (-1.0, 1.0), 1
    while usable := [pair for pair in some if len(pair[0]) > LEAST * steps]:
        parts = [[z[steps:] - z[:-steps] for z in pair] for pair in usable]
        moved, said = (np.concatenate(z) for z in zip(*parts, strict=True))
        sizes = _size(moved), _size(said)
        if min(sizes) > 0:
            cosine = float(moved @ said) / (sizes[0] * sizes[1])
            best = max(best, (cosine, sizes[0] / sizes[1]))
        steps *= 2
    return best if some else (1.0, 1.0)


def _mirrored_too(trial: Trial, relation: Integral) -> float:
    """Return 1 - cosine of a relation, with either sign: a wrong sign is not an exchange."""
    return min(_left(trial, [one]) for one in (relation, _negated(relation)))


def _negated(relation: Integral) -> Integral:
    return replace(relation, c=-relation.c)


def _left(trial: Trial, relations: Sequence[Integral]) -> float:
    """Return 1 - cosine of the worst relation; 1 if sizes differ."""
    found = [_together(trial, relation) for relation in relations]
    sized = all(1 / SIZED < ratio < SIZED for _, ratio in found)
    return 1 - min(cosine for cosine, _ in found) if sized else 1.0


def _exchanged(trial: Trial, pair: tuple[int, int]) -> Trial:
    n = len(trial.state_names)
    last = trial.inputs[-1:] if trial.steps else np.full((1, len(trial.input_names)), np.nan)
    both = np.hstack([trial.states, np.vstack([trial.inputs, last])])
    both[:, pair] = both[:, pair[::-1]]
    return replace(trial, states=both[:, :n], inputs=both[:-1, n:])


def _size(x: Array) -> float:
    return float(np.sqrt(x @ x))
